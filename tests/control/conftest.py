"""A slow machine is no failure."""

from hypothesis import settings

settings.register_profile("control", deadline=None, max_examples=40)
settings.load_profile("control")
