"""Trees in integers: what they are, and the table of their tanh; `otr.fixed_point` rounds trees and proves them."""
