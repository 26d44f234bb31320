"""The colours of a drawn tree's leaves: a hue for each label, or for low and high answers; the paler, the smaller."""

from __future__ import annotations

# Okabe & Ito's colours, which colour-blind people distinguish, as dark line and light inside, one a label.
LABELS = (
    ("#0072b2", "#a9d0ea"), ("#d55e00", "#f7c29f"), ("#009e73", "#9fdcc8"), ("#b0568a", "#ecc5da"),
    ("#b87f00", "#fadb9b"), ("#3d8fc0", "#d3ecfa"), ("#7a7000", "#efe79a"), ("#444444", "#cfcfcf"),
)  # fmt: skip
LOW, MIDDLE, HIGH = (46, 123, 189), (246, 246, 244), (226, 113, 29)  # red, green, blue of 0 to 255
UNKNOWN_LINE, UNKNOWN_FILL = "#8a7f00", "#fbf8e3"  # of a leaf whose answer varies and no state says how
LEAF_LINE = "#7b8794"
TEST_LINE, TEST_FILL, FOLDED_FILL = "#7b8794", "#ffffff", "#eef1f4"
BRANCH = "#cbd3db"


def label_colours(label: int) -> tuple[str, str]:
    """Return a label's line and inside."""
    return LABELS[label % len(LABELS)]


def level_colour(level: float) -> str:
    """Return the colour of an answer between -1, the lowest, and 1, the highest."""
    end, share = (LOW if level < 0 else HIGH), min(abs(level), 1.0) ** 0.8
    mixed = (round(middle + (full - middle) * share) for middle, full in zip(MIDDLE, end, strict=True))
    return "#" + "".join(f"{part:02x}" for part in mixed)


def ink_on(fill: str) -> str:
    """Return black or white, whichever reads better on a colour."""
    red, green, blue = (int(fill[i : i + 2], 16) for i in (1, 3, 5))
    return "#1a1a1a" if 0.299 * red + 0.587 * green + 0.114 * blue > 120 else "#ffffff"
