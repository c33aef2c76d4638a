"""What is installed, what is missing, and the one line that mends it."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import importlib.metadata
import io
import os
import platform
import re
import sys
import tempfile

from rangecheck import __version__, kernels
from rangecheck.errors import RangecheckError
from rangecheck.files import presets_folder
from rangecheck.kernels import cache_folder
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.surface.normals import area_vectors_into

#: import name -> (distribution, what it is for, needed by the main job, the line that installs it)
PACKAGES = {
    "numpy": ("numpy", "arrays", True),
    "scipy": ("scipy", "sparse solves", True),
    "numba": ("numba", "compiled kernels", True),
    "embreex": ("embreex", "rays", True),
    "trimesh": ("trimesh", "mesh files", True),
    "manifold3d": ("manifold3d", "solids and booleans", True),
    "cv2": ("opencv-contrib-python-headless", "images and structured light", True),
    "imageio_ffmpeg": ("imageio-ffmpeg", "video", True),
    "matplotlib": ("matplotlib", "charts", True),
    "PIL": ("pillow", "pictures", True),
    "pydantic": ("pydantic", "settings", True),
    "jinja2": ("jinja2", "the report", True),
    "click": ("click", "the command line", True),
    "rich": ("rich", "progress", True),
    "open3d": ("open3d", "Poisson meshing, ball pivoting, registration", False),
    "pymeshlab": ("pymeshlab", "second opinions, repair", False),
    "pye57": ("pye57", "E57 scans", False),
    "lib3mf": ("lib3mf", "3MF files", False),
    "OpenEXR": ("openexr", "EXR maps", False),
    "networkx": ("networkx", "3MF and GLB with several parts", False),
    "lxml": ("lxml", "3MF files", False),
    "distributed": ("distributed", "frames on many machines", False),
}
EXTRA = {
    "open3d": "engines",
    "pymeshlab": "engines",
    "pye57": "formats",
    "lib3mf": "formats",
    "OpenEXR": "formats",
    "networkx": "formats",
    "lxml": "formats",
    "distributed": "distributed",
}
#: what packages need of Debian beyond themselves
SYSTEM = {
    "open3d": "apt-get install libusb-1.0-0 libegl1 libgl1 libx11-6 libidn2-0 libgomp1",
    "pymeshlab": "apt-get install libgl1 libegl1 libopengl0 libgomp1",
}


def doctor() -> Outcome:
    """Check packages, system libraries, cores, the video encoder, presets and a writable cache."""
    rows: list[dict[str, object]] = []

    def row(name: str, state: str, detail: str, mend: str = "", needed: bool = True) -> None:
        rows.append({"name": name, "state": state, "detail": detail, "mend": mend, "needed": needed})

    row("python", "ok", f"{platform.python_version()} on {platform.system()} {platform.machine()}")
    row("cores", "ok", f"{kernels.thread_count()} usable")
    for module, (distribution, purpose, needed) in PACKAGES.items():
        install = f"pip install 'rangecheck[{EXTRA[module]}]'" if module in EXTRA else f"pip install {distribution}"
        try:
            version = importlib.metadata.version(distribution)
        except importlib.metadata.PackageNotFoundError:
            row(module, "missing", purpose, install, needed)
            continue
        try:
            absent = _libraries_absent(_imported(module))
        except (ImportError, OSError) as error:
            mend = SYSTEM.get(module, f"{install} --force-reinstall")
            row(module, "broken", f"{version} does not load: {str(error).splitlines()[0]}", mend, needed)
            continue
        if absent:
            row(module, "broken", f"{version} loads without parts that need {', '.join(absent)}", SYSTEM.get(module, ""), needed)
        else:
            row(module, "ok", f"{version}, {purpose}", needed=needed)
    _check_encoder(row)
    try:
        row("presets", "ok", f"{len(list(presets_folder().rglob('*.toml')))} files in {presets_folder()}")
    except RangecheckError as error:
        row("presets", "missing", str(error), "pip install --force-reinstall rangecheck")
    _check_cache(row)
    fit = all(r["state"] == "ok" for r in rows if r["needed"])
    marks = {"ok": "ok     ", "missing": "MISSING", "broken": "BROKEN "}
    lines = [
        f"{marks[str(r['state'])] if r['needed'] or r['state'] != 'missing' else 'absent '} {r['name']!s:<15} {r['detail']}"
        + (f"\n        mend with: {r['mend']}" if r["mend"] else "")
        for r in rows
    ]
    lines.append("everything needed is here" if fit else "something that the main job needs is missing")
    return Outcome(document("doctor", version=__version__, fit=fit, checks=rows), lines, fit)


def _imported(module: str) -> str:
    """Imports, and returns what libraries inside it wrote to stdout, which is for documents: MeshLab complains there of plugins."""
    everything = ctypes.CDLL(None)
    kept = os.dup(1)
    with tempfile.TemporaryFile() as said, contextlib.redirect_stdout(io.StringIO()):
        os.dup2(said.fileno(), 1)
        try:
            importlib.import_module(module)
        finally:
            everything.fflush(None)
            os.dup2(kept, 1)
            os.close(kept)
        said.seek(0)
        return said.read().decode(errors="replace")


def _libraries_absent(said: str) -> list[str]:
    """Shared libraries that the loader did not find, each once."""
    return sorted(set(re.findall(r"(lib\S+\.so\S*): cannot open shared object file", said)))


def _check_encoder(row) -> None:
    from rangecheck.export.video import find_encoder

    try:
        row("encoder", "ok", str(find_encoder()))
    except RangecheckError as error:
        row("encoder", "missing", str(error), "pip install imageio-ffmpeg")


def _check_cache(row) -> None:
    """Compiled kernels are kept (see `kernels`), or compiled anew at every start where nothing can be written."""
    if folder := cache_folder(area_vectors_into):
        row("kernel cache", "ok", str(folder))
        return
    row(
        "kernel cache",
        "missing",
        "no folder for compiled kernels can be written: every start compiles anew",
        "export NUMBA_CACHE_DIR=/a/folder",
        False,
    )


def versions() -> dict[str, str]:
    """Versions of rangecheck, Python and the packages that results depend on."""
    found = {"rangecheck": __version__, "python": sys.version.split()[0]}
    for distribution, _, _ in PACKAGES.values():
        try:
            found[distribution] = importlib.metadata.version(distribution)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
