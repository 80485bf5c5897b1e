"""The positions of the cameras: plain numbers, stored in a policy's config. ``rendering`` draws with them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class CameraPose:
    """A camera on a sphere around the point that it looks at.

    Attributes:
        name: Key of its images.
        lookat: The centre of the sphere, metres.
        distance: Radius of the sphere, metres.
        azimuth: Degrees around the vertical.
        elevation: Degrees above the horizon, negative looks down.
    """

    name: str
    lookat: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "CameraPose":
        """Reads what ``to_dict`` wrote."""
        x, y, z = (float(value) for value in values["lookat"])
        numbers = {key: float(values[key]) for key in ("distance", "azimuth", "elevation")}
        return cls(name=str(values["name"]), lookat=(x, y, z), **numbers)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


CENTRE = (0.0, 0.72, 0.12)  # of the workspace on the table
DEFAULT_CAMERAS = (
    CameraPose("left", CENTRE, 0.95, 145.0, -35.0),
    CameraPose("right", CENTRE, 0.95, 35.0, -35.0),
    CameraPose("top", CENTRE, 0.8, 90.0, -75.0),
)
# Pixels along each side. Isaac-GR00T's preprocessing crops 68 to 64, which is then not resampled.
DEFAULT_IMAGE_SIZE = 68
VIDEO_CAMERA = CameraPose("video", (0.0, 0.68, 0.15), 1.25, 140.0, -28.0)
