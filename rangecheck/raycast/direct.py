"""Embree's C interface, called from compiled code without the interpreter in between.

embreex casts one ray per call of Embree; its wheel also carries Embree itself, whose packets of 16 or, without AVX-512, 8 neighbouring rays
cost about half as much. Layouts are those of Embree 4 (rtcore_ray.h, rtcore_common.h); `load` proves them on a known triangle before they are used,
and answers None (embreex then serves alone) where the library is not found, is not what it should be, or nothing is compiled.

Local frame: centred and scaled so that the triangles fill [-1, 1]; float32, unit directions.
"""

from __future__ import annotations

import ctypes
import weakref
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import inline_kernel, kernel

_POINTER = ctypes.c_void_p
_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "rtcNewDevice": (_POINTER, [ctypes.c_char_p]),
    "rtcReleaseDevice": (None, [_POINTER]),
    "rtcGetDeviceProperty": (ctypes.c_ssize_t, [_POINTER, ctypes.c_int]),
    "rtcGetDeviceError": (ctypes.c_int, [_POINTER]),
    "rtcNewScene": (_POINTER, [_POINTER]),
    "rtcSetSceneFlags": (None, [_POINTER, ctypes.c_int]),
    "rtcCommitScene": (None, [_POINTER]),
    "rtcReleaseScene": (None, [_POINTER]),
    "rtcNewGeometry": (_POINTER, [_POINTER, ctypes.c_int]),
    "rtcSetSharedGeometryBuffer": (
        None,
        [_POINTER, ctypes.c_int, ctypes.c_uint, ctypes.c_int, _POINTER, ctypes.c_size_t, ctypes.c_size_t, ctypes.c_size_t],
    ),
    "rtcCommitGeometry": (None, [_POINTER]),
    "rtcAttachGeometry": (ctypes.c_uint, [_POINTER, _POINTER]),
    "rtcReleaseGeometry": (None, [_POINTER]),
    "rtcIntersect1": (None, [_POINTER] * 3),
    "rtcOccluded1": (None, [_POINTER] * 3),
    "rtcIntersect8": (None, [_POINTER] * 4),
    "rtcOccluded8": (None, [_POINTER] * 4),
    "rtcIntersect16": (None, [_POINTER] * 4),
    "rtcOccluded16": (None, [_POINTER] * 4),
}
#: what the engine's float32 may be off by, where numbers are about 1
_ROUNDING = 4 * float(np.finfo(np.float32).eps)
_TRIANGLES, _INDEX_BUFFER, _VERTEX_BUFFER, _UINT3, _FLOAT3 = 0, 0, 1, 0x5003, 0x9003
_COMPACT, _ROBUST = 1 << 1, 1 << 2  # less memory and somewhat slower; watertight at shared edges
#: from so many faces on a tree is compact: what decides is the mesh, not the machine, so that the same ray hits the same face everywhere
COMPACT_FROM = 4_000_000
#: rays of a packet, the widest first, and the property that says whether the processor has them
_WIDTHS = {16: 34, 8: 33}
_COHERENT = 1 << 16

# words of 4 bytes in RTCRayHit (one ray); in a packet's each is a row of as many as it has rays
_ORIGIN, _NEAR, _DIRECTION, _TIME, _FAR, _MASK, _ID, _FLAGS, _U, _V, _PRIMITIVE, _GEOMETRY, _INSTANCE = (
    0, 3, 4, 7, 8, 9, 10, 11, 15, 16, 17, 18, 19,
)  # fmt: skip
_WORDS = 24


@cache
def load() -> ctypes.CDLL | None:
    """The Embree that embreex carries, or None where it cannot be called directly."""
    if numba.config.DISABLE_JIT:
        return None
    import embreex

    package = Path(embreex.__file__).parent
    folders = (package.with_name("embreex.libs"), package / ".dylibs", package)
    for found in (path for folder in folders for path in sorted(folder.glob("*embree4*"))):
        try:
            library = ctypes.CDLL(str(found))
            for name, (result, arguments) in _SIGNATURES.items():
                function = getattr(library, name)
                function.restype, function.argtypes = result, arguments
        except (OSError, AttributeError):
            continue
        return library if _proved(library) else None
    return None


#: trees are built one at a time: none must be built while the device lives that allows more threads
_building = Lock()
_awake: list[int] = []


@cache
def _device() -> int:
    library = load()
    assert library is not None
    # one thread builds: the tree, and so which of two faces wins at their shared edge, is then the same on every machine
    return library.rtcNewDevice(b"threads=1")


def _proved(library: ctypes.CDLL) -> bool:
    """Whether one triangle answers single rays and packets as the layouts above say it must."""
    device = library.rtcNewDevice(b"threads=1")
    if not device or not _width(library, device):
        return False
    corners = with_room(3)
    corners[:] = [[0, 0, 0.5], [1, 0, 0.5], [0, 1, 0.5]]
    tree = DirectScene(corners, np.array([[0, 1, 2]], np.int32), library, device)
    origins = np.tile(np.array([0.25, 0.5, -0.5], np.float32), (17, 1))
    origins[16, 0] = 2.0
    directions = np.tile(np.array([0, 0, 1], np.float32), (17, 1))
    for coherent in (False, True):
        far, face = np.full(17, 9, np.float32), np.zeros(17, np.int32)
        u, v = np.zeros(17, np.float32), np.zeros(17, np.float32)
        blocked = np.zeros(17, np.bool_)
        tree.closest(origins, directions, far, face, u, v, coherent)
        tree.occluded(origins, directions, np.full(17, 0.5 if coherent else 2.0, np.float32), blocked, coherent)
        # older processors divide by an estimate and one step of Newton's method
        met = np.abs(np.stack([far[:16] - 1, u[:16] - 0.25, v[:16] - 0.5])).max() <= _ROUNDING
        right = met and (face[:16] == 0).all()
        if not (right and face[16] == -1 and (blocked[:16] != coherent).all() and not blocked[16]):
            return False
    return True


def _width(library: ctypes.CDLL, device: int) -> int:
    """Rays of the widest packets that the processor has; 0 where it has none that pay."""
    return next((width for width, key in _WIDTHS.items() if library.rtcGetDeviceProperty(device, key) == 1), 0)


def _commit(library: ctypes.CDLL, scene: int) -> None:
    """Build a scene's tree on one thread, and let the engine's helpers sleep afterwards.

    TBB, held to one thread, leaves a helper behind that looks for work for ever and takes a core from the tracing; it goes to sleep where more
    threads are allowed, as they are while a device lives that may use them."""
    with _building:
        while _awake:
            library.rtcReleaseDevice(_awake.pop())
        library.rtcCommitScene(scene)
        _awake.append(library.rtcNewDevice(b"threads=2"))


def _release(library: ctypes.CDLL, scene: int, shared: tuple[FloatArray, IntArray]) -> None:
    library.rtcReleaseScene(scene)


def with_room(count: int) -> FloatArray:
    """(count, 3) float32 for vertices that Embree reads where they stand: 16 bytes at a time, so that there must be 4 after the last."""
    return np.empty(3 * count + 1, np.float32)[:-1].reshape(-1, 3)


class DirectScene:
    """Triangles (n, 3) float32 local from `with_room`, (m, 3) int32 in one Embree scene, which are read as long as it lives."""

    def __init__(
        self, vertices: FloatArray, faces: IntArray, library: ctypes.CDLL | None = None, device: int | None = None
    ) -> None:
        library, device = library or load(), device or _device()
        assert library is not None
        self._width = _width(library, device)
        self._scene = library.rtcNewScene(device)
        library.rtcSetSceneFlags(self._scene, _ROBUST | (_COMPACT if len(faces) >= COMPACT_FROM else 0))
        geometry = library.rtcNewGeometry(device, _TRIANGLES)
        self._shared = (vertices, np.ascontiguousarray(faces))
        for kind, form, array in zip((_VERTEX_BUFFER, _INDEX_BUFFER), (_FLOAT3, _UINT3), self._shared):
            library.rtcSetSharedGeometryBuffer(geometry, kind, 0, form, array.ctypes.data, 0, 12, len(array))
        library.rtcCommitGeometry(geometry)
        library.rtcAttachGeometry(self._scene, geometry)
        library.rtcReleaseGeometry(geometry)
        _commit(library, self._scene)
        # the scene goes before what it reads
        weakref.finalize(self, _release, library, self._scene, self._shared)
        self._address = {
            name: ctypes.cast(getattr(library, name), _POINTER).value
            for name in ("rtcIntersect1", "rtcOccluded1", f"rtcIntersect{self._width}", f"rtcOccluded{self._width}")
        }

    def closest(
        self,
        origins: FloatArray,
        directions: FloatArray,
        far: FloatArray,
        face: IntArray,
        u: FloatArray,
        v: FloatArray,
        coherent: bool,
    ) -> None:
        """Fill `far`, `face` (-1 = missed), `u`, `v` with the first hits; `far` comes in as the reach of each ray."""
        if coherent:
            packets = self._address[f"rtcIntersect{self._width}"]
            _closest_packets(packets, self._width, self._scene, origins, directions, far, face, u, v)
        else:
            _closest_single(self._address["rtcIntersect1"], self._scene, origins, directions, far, face, u, v)

    def occluded(self, origins: FloatArray, directions: FloatArray, far: FloatArray, blocked: Any, coherent: bool) -> None:
        """Fill `blocked` (n,) bool: whether anything lies within `far` of each ray's origin."""
        if coherent:
            packets = self._address[f"rtcOccluded{self._width}"]
            _occluded_packets(packets, self._width, self._scene, origins, directions, far, blocked)
        else:
            _occluded_single(self._address["rtcOccluded1"], self._scene, origins, directions, far, blocked)


def _call(arguments: int) -> Any:
    def typed(context, address, *rest):
        signature = types.void(*([types.intp] * (arguments + 1)))

        def generate(context, builder, signature, values):
            word = context.get_value_type(types.intp)
            function = ir.FunctionType(ir.VoidType(), [word] * arguments)
            builder.call(builder.inttoptr(values[0], function.as_pointer()), values[1:])
            return context.get_dummy_value()

        return signature, generate

    return typed


@intrinsic
def _call3(context, address, a, b, c):
    """Call the C function at `address` with three words."""
    return _call(3)(context, address, a, b, c)


@intrinsic
def _call4(context, address, a, b, c, d):
    """Call the C function at `address` with four words."""
    return _call(4)(context, address, a, b, c, d)


@inline_kernel
def _aligned(words):
    """`words` float32 of zeros that start on a 64-byte line, as Embree's packets must."""
    room = np.zeros(words + 16, np.float32)
    skip = (-room.ctypes.data % 64) // 4
    return room[skip : skip + words]


@inline_kernel
def _coherent_arguments():
    """RTCIntersectArguments (and RTCOccludedArguments): coherent rays, all features, no context, no filters."""
    arguments = _aligned(16)
    words = arguments.view(np.int32)
    words[0] = _COHERENT
    words[1] = -1
    return arguments


@inline_kernel
def _finite_ray(origins, directions, i):
    total = origins[i, 0] + origins[i, 1] + origins[i, 2] + directions[i, 0] + directions[i, 1] + directions[i, 2]
    return total - total == 0.0


@inline_kernel
def _fill_ray(ray, words, origins, directions, far, i):
    for axis in range(3):
        ray[_ORIGIN + axis] = origins[i, axis]
        ray[_DIRECTION + axis] = directions[i, axis]
    ray[_NEAR] = ray[_TIME] = 0.0
    ray[_FAR] = far[i]
    words[_MASK] = -1
    words[_ID] = words[_FLAGS] = 0


@kernel
def _closest_single(function, scene, origins, directions, far, face, u, v):
    """One ray per call: best where neighbouring rays have little in common."""
    ray = _aligned(_WORDS)
    words = ray.view(np.int32)
    place = ray.ctypes.data
    for i in range(len(origins)):
        _fill_ray(ray, words, origins, directions, far, i)
        words[_PRIMITIVE] = words[_GEOMETRY] = words[_INSTANCE] = -1
        if _finite_ray(origins, directions, i):
            _call3(function, scene, place, 0)
        far[i] = ray[_FAR]
        face[i] = words[_PRIMITIVE]
        u[i] = ray[_U]
        v[i] = ray[_V]


@kernel
def _occluded_single(function, scene, origins, directions, far, blocked):
    """One ray per call; Embree marks a blocked ray by a negative infinite reach."""
    ray = _aligned(_WORDS)
    words = ray.view(np.int32)
    place = ray.ctypes.data
    for i in range(len(origins)):
        _fill_ray(ray, words, origins, directions, far, i)
        if _finite_ray(origins, directions, i):
            _call3(function, scene, place, 0)
        blocked[i] = ray[_FAR] < 0.0


@inline_kernel
def _fill_packet(ray, words, valid, width, origins, directions, far, first, count):
    """Rays first..first+count into the lanes; lanes that are left over, or hold a ray that is not finite, are switched off."""
    for lane in range(width):
        i = first + lane
        if lane < count and _finite_ray(origins, directions, i):
            valid[lane] = -1
            for axis in range(3):
                ray[(_ORIGIN + axis) * width + lane] = origins[i, axis]
                ray[(_DIRECTION + axis) * width + lane] = directions[i, axis]
            ray[_FAR * width + lane] = far[i]
        else:
            valid[lane] = 0
            ray[_FAR * width + lane] = 0.0
        words[_MASK * width + lane] = -1
        words[_PRIMITIVE * width + lane] = words[_GEOMETRY * width + lane] = words[_INSTANCE * width + lane] = -1


@kernel
def _closest_packets(function, width, scene, origins, directions, far, face, u, v):
    """`width` rays per call: for rays whose neighbours in the list are neighbours in space."""
    ray, lanes, arguments = _aligned(_WORDS * width), _aligned(16), _coherent_arguments()
    words, valid = ray.view(np.int32), lanes.view(np.int32)
    n = len(origins)
    for first in range(0, n, width):
        count = min(width, n - first)
        _fill_packet(ray, words, valid, width, origins, directions, far, first, count)
        _call4(function, lanes.ctypes.data, scene, ray.ctypes.data, arguments.ctypes.data)
        for lane in range(count):
            i = first + lane
            if valid[lane] != 0:
                far[i] = ray[_FAR * width + lane]
            face[i] = words[_PRIMITIVE * width + lane]
            u[i] = ray[_U * width + lane]
            v[i] = ray[_V * width + lane]


@kernel
def _occluded_packets(function, width, scene, origins, directions, far, blocked):
    """`width` shadow rays per call."""
    ray, lanes, arguments = _aligned(_WORDS * width), _aligned(16), _coherent_arguments()
    words, valid = ray.view(np.int32), lanes.view(np.int32)
    n = len(origins)
    for first in range(0, n, width):
        count = min(width, n - first)
        _fill_packet(ray, words, valid, width, origins, directions, far, first, count)
        _call4(function, lanes.ctypes.data, scene, ray.ctypes.data, arguments.ctypes.data)
        for lane in range(count):
            blocked[first + lane] = ray[_FAR * width + lane] < 0.0
