"""Videos that give back every frame as it was: H.264 in RGB, without loss."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

from saccade._internal.arrays import UInt8Array
from saccade._internal.extras import SACCADE

#: Without loss, and with a keyframe every few frames, which makes any frame quick to reach.
OPTIONS = {"qp": "0", "g": "10", "bf": "0", "forced-idr": "1"}
CODEC, PIXELS = "libx264rgb", "gbrp"


class VideoFile:
    """A video that frames are appended to.

    Args:
        path: The file, an MP4.
        fps: Frames per second.
        height, width: The size of the frames.

    Attributes:
        count: Number of frames so far.
        size: Bytes so far, without those that the encoder still has.
    """

    def __init__(self, path: Path, fps: int, height: int, width: int) -> None:
        SACCADE.require("av")
        import av

        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.fps = fps
        self.count = 0
        self.size = 0
        self._container: Any = av.open(str(path), "w")
        stream: Any = self._container.add_stream(CODEC, rate=fps, options=OPTIONS)
        stream.height, stream.width, stream.pix_fmt = height, width, "rgb24"
        self._stream = stream

    @property
    def duration(self) -> float:
        """Time of the next frame, seconds."""
        return self.count / self.fps

    def append(self, frames: UInt8Array) -> None:
        """Appends frames ``(count, height, width, 3)``.

        The first is a keyframe, so that programs that copy a part of a video can cut there.
        """
        import av
        from av.video.frame import PictureType

        for place, pixels in enumerate(frames):
            frame: Any = av.VideoFrame.from_ndarray(pixels, "rgb24")
            if not place:
                frame.pict_type = PictureType.I
            frame.pts, frame.time_base = self.count, Fraction(1, self.fps)
            self._write(self._stream.encode(frame))
            self.count += 1

    def close(self) -> None:
        """Writes what is still in the encoder, and closes the file."""
        try:
            self._write(self._stream.encode())
        finally:
            self._container.close()

    def _write(self, packets: list[Any]) -> None:
        self.size += sum(packet.size for packet in packets)
        self._container.mux(packets)


def video_info(fps: int, height: int, width: int) -> dict[str, Any]:
    """``info`` of a camera in ``info.json``, as lerobot writes it."""
    return {
        "video.height": height,
        "video.width": width,
        "video.codec": "h264",
        "video.pix_fmt": PIXELS,
        "video.fps": fps,
        "video.channels": 3,
        "has_audio": False,
        "is_depth_map": False,
    }
