"""Tables, figures and data frames from finished runs and fits.

`load_runs` and `load_fits` return all of them as data frames; pandas is imported when one of the two is used.
"""

from typing import TYPE_CHECKING

from otr.extras import lazy_exports

if TYPE_CHECKING:
    from pipelines.report.frames import load_fits as load_fits
    from pipelines.report.frames import load_runs as load_runs

__getattr__, __dir__ = lazy_exports(__name__, {"load_fits": "frames", "load_runs": "frames"})
