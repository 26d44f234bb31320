"""What a run is asked to do: frozen dataclasses, a module a group of conf/; nothing here knows Hydra."""
