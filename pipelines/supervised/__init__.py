"""Trees from data: `otr-fit`, its learners and stages, and Table 4.2."""
