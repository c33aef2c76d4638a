"""Frames to a film: MP4 (H.264), WebM (VP9), GIF, APNG, through the ffmpeg that imageio-ffmpeg brings.

sRGB pictures in, Rec. 709 out. One encoder thread and no dates: the same frames give the same bytes. A loop of N frames holds
exactly N frames; players repeat it.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rangecheck.errors import ArrayError, DependencyMissing, OutputError
from rangecheck.export.pictures import Picture, read_png
from rangecheck.files import whole_file

_TO_709 = "scale=in_range=pc:out_range=tv:out_color_matrix=bt709,format=yuv420p"
_TAGS = ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "iec61966-2-1", "-color_range", "tv"]
#: what each ending needs of ffmpeg: encoder, and options between input and output
FORMATS: dict[str, tuple[str, list[str]]] = {
    ".mp4": (
        "libx264",
        ["-vf", _TO_709, "-crf", "18", "-preset", "veryfast", "-x264-params", "threads=1:lookahead-threads=1:sliced-threads=0"]
        + [*_TAGS, "-movflags", "+faststart"],
    ),
    ".webm": ("libvpx-vp9", ["-vf", _TO_709, "-crf", "30", "-b:v", "0", "-deadline", "good", "-cpu-used", "4", *_TAGS]),
    ".gif": (
        "gif",
        ["-filter_complex", "split[a][b];[a]palettegen=stats_mode=full[p];[b][p]paletteuse=dither=sierra2_4a", "-loop", "0"],
    ),
    ".apng": ("apng", ["-plays", "0", "-f", "apng"]),
}
_REMEDY = "pip install imageio-ffmpeg"

Frame = str | Path | npt.NDArray[np.uint8]


def find_encoder(suffix: str = ".mp4") -> str:
    """Path of an ffmpeg that can write `suffix` (.mp4, .webm, .gif, .apng). Raises DependencyMissing, before any frame is made."""
    if suffix not in FORMATS:
        raise ArrayError(f"films end in {', '.join(FORMATS)}, not in {suffix!r}", name="suffix")
    purpose = f"writing {suffix} films"
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        encoder = get_ffmpeg_exe()
        listed = subprocess.run(
            [encoder, "-hide_banner", "-encoders"], capture_output=True, text=True, timeout=60, check=True
        ).stdout
    except (ImportError, RuntimeError, OSError, subprocess.SubprocessError):
        raise DependencyMissing("ffmpeg", purpose, _REMEDY) from None
    if FORMATS[suffix][0] not in {line.split()[1] for line in listed.splitlines() if len(line.split()) > 1}:
        raise DependencyMissing(f"ffmpeg with {FORMATS[suffix][0]}", purpose, f"{_REMEDY}, and unset IMAGEIO_FFMPEG_EXE")
    return str(encoder)


def write_film(frames: Iterable[Frame] | Sequence[Frame], path: str | Path, fps: float = 24.0, *, force: bool = True) -> None:
    """Write frames - PNG paths or uint8 (h, w) or (h, w, 3) arrays, all of one size - as the film that `path`'s ending names.

    MP4 and WebM need even sizes: an odd one gains a copied border line. Raises ArrayError (no frames, unlike sizes, fps),
    DependencyMissing, OutputError."""
    target = Path(path)
    if not (np.isfinite(fps) and 0 < fps <= 1000):
        raise ArrayError(f"fps is {fps}; it must be a positive number up to 1000", name="fps")
    encoder = find_encoder(target.suffix.lower())
    codec, options = FORMATS[target.suffix.lower()]
    even = target.suffix.lower() in (".mp4", ".webm")
    pictures = _pictures(frames, even)
    try:
        first = next(pictures)
    except StopIteration:
        raise ArrayError("there are no frames to make a film of", name="frames") from None
    height, width = first.shape[:2]
    with whole_file(target, force=force) as part, tempfile.TemporaryFile() as log:
        command = [encoder, "-hide_banner", "-loglevel", "error", "-nostdin", "-y", "-threads", "1", "-filter_threads", "1"]
        command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "pipe:0"]
        command += [*options, "-c:v", codec, "-threads", "1", "-an", "-map_metadata", "-1"]
        command += ["-fflags", "+bitexact", "-flags:v", "+bitexact", str(part)]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log)
        assert process.stdin is not None
        try:
            for picture in chain([first], pictures):
                if picture.shape != first.shape:
                    raise ArrayError(
                        f"frames have sizes {first.shape[:2]} and {picture.shape[:2]}; a film has one", name="frames"
                    )
                process.stdin.write(picture.tobytes())
        except BrokenPipeError:
            pass  # its status and its own words follow
        except BaseException:
            process.kill()
            raise
        finally:
            with suppress(BrokenPipeError):
                process.stdin.close()
            process.wait()
        if process.returncode != 0:
            log.seek(0)
            said = log.read(2000).decode(errors="replace").strip().replace("\n", "; ")
            raise OutputError(target, f"ffmpeg could not write the film ({said or f'status {process.returncode}'})")


def write_mp4(frames: Iterable[Frame], path: str | Path, fps: float = 24.0, *, force: bool = True) -> None:
    """`write_film` under the name most people look for; `path` must end in .mp4."""
    if Path(path).suffix.lower() != ".mp4":
        raise OutputError(path, "must end in .mp4; write_film takes the other endings")
    write_film(frames, path, fps, force=force)


def _pictures(frames: Iterable[Frame], even: bool) -> Iterator[Picture]:
    for frame in frames:
        picture = frame if isinstance(frame, np.ndarray) else read_png(frame)
        if picture.dtype != np.uint8 or picture.ndim not in (2, 3) or picture.size == 0:
            raise ArrayError(f"a frame is {picture.dtype} of shape {picture.shape}; films take uint8 grey or RGB", name="frames")
        if picture.ndim == 2:
            picture = np.repeat(picture[..., None], 3, axis=2)
        picture = picture[..., :3]
        if even and (picture.shape[0] % 2 or picture.shape[1] % 2):
            picture = np.pad(picture, ((0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0)), mode="edge")
        yield np.ascontiguousarray(picture)
