"""The same readers, fed by a fuzzer that follows which branches their Python takes (atheris, libFuzzer): pip install 'rangecheck[fuzz]'

    python tests/fuzz/guided.py GROUP FOLDER -runs=20000 -seed=1

GROUP is one of meshes, settings, scenes, documents, pictures, readers. FOLDER keeps the corpus: the good files of the group at first, then
what reached something new. A wrong answer ends the run and is kept as crash-*, slow ones (5 s) as timeout-*, large ones (1 GB) as oom-*.
The first byte chooses which of the group's readers gets the rest.
"""

from __future__ import annotations

import importlib.util
import logging
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import atheris

#: parsers in Python
FOLLOWED = [
    "tomllib", "rangecheck.config", "rangecheck.dataset.index", "rangecheck.dataset.ranges", "rangecheck.export.camera_files", "rangecheck.export.map_files",
    "rangecheck.export.exr", "rangecheck.modeler.scene_file", "rangecheck.modeler.primitives", "rangecheck.modeler.profiles", "rangecheck.reflectance.material",
    "rangecheck.scan.readers", "rangecheck.scan.decode.capture", "rangecheck.solid.printer", "rangecheck.surface.mesh_files", "rangecheck.surface.ply_files",
    "rangecheck.surface.stl_files", "rangecheck.optics.cameras",
]  # fmt: skip
HERE = Path(__file__).resolve().parent


def left_alone() -> list[str]:
    """The modules of rangecheck that are not followed, and all that hold kernels: what numba compiles must stay as it is written. (atheris looks at
    the first name of what it is to include only, and would follow all of rangecheck.)"""
    spec = importlib.util.find_spec("rangecheck")
    assert spec is not None and spec.origin is not None
    package = Path(spec.origin).parent
    alone = []
    for file in package.rglob("*.py"):
        name = ".".join(("rangecheck", *file.relative_to(package).with_suffix("").parts)).removesuffix(".__init__")
        followed = any(name == one or name.startswith(f"{one}.") for one in FOLLOWED)
        if not followed or "kernels import" in file.read_text(encoding="utf-8"):
            alone.append(name)
    return alone


with atheris.instrument_imports(include=FOLLOWED, exclude=left_alone()):
    sys.path.insert(0, str(HERE.parent))
    from fuzz.entries import GROUPS
    from fuzz.mutate import companion, corpus
    from rangecheck.errors import RangecheckError
    from rangecheck.scan.readers import read_measured

Feed = Callable[[bytes], None]


def of_entries(group: str, folder: Path) -> tuple[list[Feed], list[tuple[int, bytes]]]:
    """What feeds each reader of a group, and its good files."""
    entries = GROUPS[group](folder)
    place = folder / "fuzzed"
    place.mkdir(exist_ok=True)

    def feed_of(entry) -> Feed:
        def feed(content: bytes) -> None:
            (place / entry.name).write_bytes(content)
            entry.read(place / entry.name)

        return feed

    return [feed_of(entry) for entry in entries], [(k, good) for k, entry in enumerate(entries) for good in entry.good]


def of_readers(folder: Path) -> tuple[list[Feed], list[tuple[int, bytes]]]:
    """The same for readers of scans."""
    files = corpus(folder / "corpus")
    for name in ("good.png", "good.ply"):
        (folder / name).write_bytes(files[name])
    names = [name for name in files if not name.startswith("good")]

    def feed_of(name: str) -> Feed:
        path = folder / f"fuzzed{Path(name).suffix}"
        says_its_unit = path.suffix in (".npz", ".json", ".png", ".tif", ".exr", ".pfm", ".cyb", ".pcd")

        def feed(content: bytes) -> None:
            path.write_bytes(content)
            beside = companion(name)
            if beside is not None:
                path.with_suffix(".json").write_bytes(beside)
            read_measured(path, None if says_its_unit else "mm")

        return feed

    return [feed_of(name) for name in names], [(k, files[name]) for k, name in enumerate(names)]


def main() -> None:
    group, kept, *options = sys.argv[1:]
    logging.disable()
    Path(kept).mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp())
    feeds, good = of_readers(folder) if group == "readers" else of_entries(group, folder)
    for number, (reader, content) in enumerate(good):
        (Path(kept) / f"good_{number:03d}").write_bytes(bytes([reader]) + content)

    def one(data: bytes) -> None:
        if not data:
            return
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                feeds[data[0] % len(feeds)](data[1:])
        except RangecheckError as error:
            if "\n" in str(error):
                raise RuntimeError(f"more than one line: {error}") from error

    limits = ["-timeout=5", "-rss_limit_mb=2048", "-max_len=20000", f"-artifact_prefix={kept}/"]
    atheris.Setup([sys.argv[0], kept, *limits, *options], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
