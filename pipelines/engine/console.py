"""How numbers are shown in a terminal."""

SHORT_PROGRAM = 40  # lines; a longer one is named, not shown


def duration(seconds: float) -> str:
    """Return seconds as people read them: 45 s, 12 min, 3.5 h."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 100 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
