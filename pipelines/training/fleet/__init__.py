"""Many runs of the soft actor-critic of `otr.control.sac` trained as one, with their checkpoints and progress."""
