"""The units of what gymnasium's environments observe, where these are physical quantities."""

from pipelines.config.env import EnvConfig

# By the end of a name in conf/env. Box2D's environments scale their observations, which so have no unit.
_UNITS = {"angle_rate": "rad/s", "_rate": "rad/s", "_angle": "rad", "_velocity": "m/s", "position": "m"}
_PHYSICAL = ("Pendulum-", "Hopper-", "Walker2d-", "HalfCheetah-", "Ant-", "Swimmer-", "Reacher-")
_LENGTHS = ("x", "y", "z", "target_x", "target_y", "distance_x", "distance_y", "distance_z")
_PLAIN = ("cos_", "sin_")  # how names of plain numbers begin


def unit_of(env: EnvConfig, feature: str) -> str:
    """Return the unit of an observation of gymnasium's Pendulum and MuJoCo environments; "" where it has none.

    Names are those of conf/env; a custom environment's observations have no known unit.
    """
    if not env.id.startswith(_PHYSICAL) or feature.startswith(_PLAIN):
        return ""
    if feature in _LENGTHS:
        return "m"
    return next((unit for end, unit in _UNITS.items() if feature.endswith(end)), "")
