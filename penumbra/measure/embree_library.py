"""Embree 4 through its C interface: the library inside the `embreex` wheel, and a scene of triangles in it.

Embree sets flush-to-zero in its threads, which breaks exact arithmetic on subnormal numbers, so this is
used in a process of its own. The interface is described in Embree's manual and its public headers.
"""

import ctypes
import importlib.util
from ctypes import CFUNCTYPE, c_bool, c_char_p, c_int, c_size_t, c_ssize_t, c_uint, c_void_p
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from penumbra.errors import BackendError

_VERSION, _RAY16_IS_NATIVE = 0, 34  # RTCDeviceProperty
_TRIANGLES = 0  # RTCGeometryType
_INDICES, _VERTICES = 0, 1  # RTCBufferType
_UINT3, _FLOAT3 = 0x5003, 0x9003  # RTCFormat
_MEDIUM_QUALITY = 1  # RTCBuildQuality, Embree's default
_COMPACT, _ROBUST = 1 << 1, 1 << 2  # RTCSceneFlags
_COHERENT = 1 << 16  # RTCRayQueryFlags; 0 is incoherent
_ONLY_TRIANGLES = 1 << 1  # RTCFeatureFlags: no filter, no instance, no other geometry

# bool (void *user, ssize_t bytes, bool post): every allocation, and every release as a negative number.
_Monitor = CFUNCTYPE(c_bool, c_void_p, c_ssize_t, c_bool)

# Result and arguments of every function that is called; handles are pointers nobody looks into.
_FUNCTIONS = {
    "rtcNewDevice": (c_void_p, [c_char_p]),
    "rtcReleaseDevice": (None, [c_void_p]),
    "rtcGetDeviceProperty": (c_ssize_t, [c_void_p, c_int]),
    "rtcGetDeviceError": (c_int, [c_void_p]),
    "rtcSetDeviceMemoryMonitorFunction": (None, [c_void_p, _Monitor, c_void_p]),
    "rtcNewGeometry": (c_void_p, [c_void_p, c_int]),
    "rtcSetSharedGeometryBuffer": (
        None,
        [c_void_p, c_int, c_uint, c_int, c_void_p, c_size_t, c_size_t, c_size_t],
    ),
    "rtcSetGeometryBuildQuality": (None, [c_void_p, c_int]),
    "rtcCommitGeometry": (None, [c_void_p]),
    "rtcReleaseGeometry": (None, [c_void_p]),
    "rtcNewScene": (c_void_p, [c_void_p]),
    "rtcSetSceneBuildQuality": (None, [c_void_p, c_int]),
    "rtcSetSceneFlags": (None, [c_void_p, c_int]),
    "rtcAttachGeometry": (c_uint, [c_void_p, c_void_p]),
    "rtcCommitScene": (None, [c_void_p]),
    "rtcReleaseScene": (None, [c_void_p]),
}


class OccludedArguments(ctypes.Structure):
    """Options of an occlusion query: flags, features, and three pointers that stay null."""

    _fields_ = (
        ("flags", c_uint),
        ("feature_mask", c_uint),
        ("context", c_void_p),
        ("filter", c_void_p),
        ("occluded", c_void_p),
    )


def library_path() -> Path | None:
    """Where the wheel keeps Embree; None when it is not installed."""
    found = importlib.util.find_spec("embreex")
    if found is None or not found.submodule_search_locations:
        return None
    package = Path(found.submodule_search_locations[0])
    for folder in (package.parent / "embreex.libs", package / ".dylibs", package):
        for path in sorted(folder.glob("libembree4*")):
            return path
    return None


class EmbreeScene:
    """Triangles in Embree's acceleration structure, ready for occlusion queries by address."""

    def __init__(
        self,
        vertices: NDArray[np.float32],
        triangles: NDArray[np.uint32],
        threads: int,
        robust: bool = False,
        compact: bool = False,
    ) -> None:
        """Build over vertices (V, 3) float32 and triangles (T, 3) uint32, which Embree shares.

        threads: of the build. Raises BackendError where Embree is not installed or fails.
        """
        path = library_path()
        if path is None:
            raise BackendError("Embree is not installed: install the package embreex to measure against it")
        self._library = ctypes.CDLL(str(path))
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(self._library, name)
            function.restype, function.argtypes = result, arguments
        self.bytes = self.peak_bytes = 0
        self._monitor = _Monitor(self._count_bytes)
        # Embree reads a vertex with one load of 16 bytes: the last one needs four bytes behind it.
        self._vertices = np.empty(3 * len(vertices) + 1, np.float32)
        self._vertices[:-1] = np.ravel(vertices)
        self._triangles = np.ascontiguousarray(triangles, np.uint32)
        self._device = self._library.rtcNewDevice(f"threads={threads},set_affinity=0".encode())
        if not self._device:
            raise BackendError("Embree cannot start on this machine")
        self._library.rtcSetDeviceMemoryMonitorFunction(self._device, self._monitor, None)
        self._scene = self._library.rtcNewScene(self._device)
        self._library.rtcSetSceneBuildQuality(self._scene, _MEDIUM_QUALITY)
        self._library.rtcSetSceneFlags(self._scene, _ROBUST * robust | _COMPACT * compact)
        self._attach_triangles()
        self._library.rtcCommitScene(self._scene)
        error = self._library.rtcGetDeviceError(self._device)
        if error:
            raise BackendError(f"Embree reports error {error} after building its acceleration structure")
        self._options = {flag: OccludedArguments(_COHERENT * flag, _ONLY_TRIANGLES) for flag in (False, True)}

    @property
    def address(self) -> int:
        """The scene, as the C interface wants it."""
        return int(self._scene)

    @property
    def occluded16(self) -> int:
        """Address of the function that traces a packet of 16 occlusion rays."""
        return int(ctypes.cast(self._library.rtcOccluded16, c_void_p).value or 0)

    def arguments(self, coherent: bool) -> int:
        """Address of the options of a query, with Embree's flag for coherent or for incoherent rays."""
        return ctypes.addressof(self._options[coherent])

    @property
    def version(self) -> str:
        """Version of the library, such as `4.4.0`."""
        number = self._library.rtcGetDeviceProperty(self._device, _VERSION)
        return f"{number // 10000}.{number // 100 % 100}.{number % 100}"

    @property
    def has_native_packets(self) -> bool:
        """Whether this processor traces 16 rays at once; elsewhere Embree splits the packets."""
        return bool(self._library.rtcGetDeviceProperty(self._device, _RAY16_IS_NATIVE))

    def close(self) -> None:
        """Free the acceleration structure."""
        self._library.rtcReleaseScene(self._scene)
        self._library.rtcReleaseDevice(self._device)

    def _attach_triangles(self) -> None:
        library = self._library
        geometry = library.rtcNewGeometry(self._device, _TRIANGLES)
        for kind, form, array, count in (
            (_VERTICES, _FLOAT3, self._vertices, len(self._vertices) // 3),
            (_INDICES, _UINT3, self._triangles, len(self._triangles)),
        ):
            library.rtcSetSharedGeometryBuffer(geometry, kind, 0, form, array.ctypes.data, 0, 12, count)
        library.rtcSetGeometryBuildQuality(geometry, _MEDIUM_QUALITY)
        library.rtcCommitGeometry(geometry)
        library.rtcAttachGeometry(self._scene, geometry)
        library.rtcReleaseGeometry(geometry)

    def _count_bytes(self, _user: int | None, n_bytes: int, _post: bool) -> bool:
        """Keep count of what Embree allocates; called from its threads, one at a time under the GIL."""
        self.bytes += n_bytes
        self.peak_bytes = max(self.peak_bytes, self.bytes)
        return True
