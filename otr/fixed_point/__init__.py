"""Trees in fixed point: rounded, proved, and of the shortest words that a proof allows.

The package imports what checks its certificates, so that `otr.verify` knows them wherever there is one.
"""

from otr.fixed_point import certify as certify
