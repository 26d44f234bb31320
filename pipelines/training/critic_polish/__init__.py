"""Polishing by critics: the soft actor-critic goes on with a finished policy in the place of the actor."""
