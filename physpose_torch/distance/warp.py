"""Signed and drop distances by NVIDIA Warp: one thread a part pair, CPU and CUDA, float32 and float64 from one source.

The kernels (``physpose_torch/distance/kernels``) are compiled on first use, which takes some seconds, and cached by Warp.
``torch.compile`` sees two opaque operators, ``physpose_torch::signed_distance`` and ``physpose_torch::drop_distance``.
"""

import atexit
import contextlib
import functools
import logging
import os
import shutil
import tempfile
import threading
import weakref
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from physpose_torch import se3
from physpose_torch.config import Smoothing
from physpose_torch.distance.kernels.pair import pairs as pair_kernels
from physpose_torch.distance.kernels.shapes import LANES, shapes
from physpose_torch.distance.kernels.smooth import smooth
from physpose_torch.distance.smoothing import CONTACT_BLUR, smoothing_nodes
from physpose_torch.distance.support import DistanceResult
from physpose_torch.errors import BackendError
from physpose_torch.geometry.convex import ConvexParts

__all__ = [
    "REAL",
    "fill",
    "launch",
    "parts_struct",
    "ready",
    "warp_distance",
    "warp_drop",
    "warp_query",
    "wobble_struct",
    "wrap",
]

logger = logging.getLogger("physpose_torch")

REAL = {torch.float32: wp.float32, torch.float64: wp.float64}
PATIENCE = 1.5
"""[s]; loading compiled kernels takes less."""
ROOM = 1 << 22
"""[bytes]; what a module takes when it is compiled is a fifth of this."""
_structs: "weakref.WeakKeyDictionary[ConvexParts, dict]" = weakref.WeakKeyDictionary()


@functools.cache
def initialise() -> None:
    """Start Warp, quietly."""
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)  # no banner, no load times
    quiet = contextlib.nullcontext if torch.cuda.is_available() else _silent
    try:
        if not (os.environ.get("WARP_CACHE_PATH") or os.path.isabs(os.path.expanduser("~"))):
            raise FileNotFoundError("this user has no home folder")
        with quiet():
            wp.init()
    except OSError as error:
        _compile_elsewhere(error)
        with quiet():
            wp.init()


@functools.cache
def _temporary() -> str:
    """A folder for kernels that lasts as long as this process, and not only as long as one that it forks."""
    folder, maker = tempfile.mkdtemp(prefix="physpose-kernels-"), os.getpid()
    atexit.register(lambda: os.getpid() == maker and shutil.rmtree(folder, ignore_errors=True))
    return folder


def _compile_elsewhere(error: Exception) -> None:
    logger.warning(
        "Warp's kernel cache cannot be used (%s): kernels are compiled for this process alone; "
        "set WARP_CACHE_PATH to a writable folder",
        error,
    )
    wp.config.kernel_cache_dir = _temporary()


def _make_sure_of_room(module: "wp.Module") -> None:
    """OSError if a module has to be compiled and the disk is full: the compiler would abort the whole process."""
    if not os.path.isdir(os.path.join(wp.config.kernel_cache_dir, module.get_module_identifier())):
        with tempfile.TemporaryFile(dir=wp.config.kernel_cache_dir) as probe:
            probe.write(bytes(ROOM))


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """No standard error, not even of C code: Warp warns of a missing CUDA driver, which is no news on a CPU."""
    try:
        kept = os.dup(2)
    except OSError:  # there is none
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


@functools.cache
def ready(make: Callable[[type], SimpleNamespace], dtype: torch.dtype, device: torch.device) -> SimpleNamespace:
    """The kernels that ``make`` makes for a dtype, compiled for a device."""
    initialise()
    kernels = make(REAL[dtype])
    load(kernels.module, device)
    return kernels


def load(module: "wp.Module", device: torch.device) -> None:
    """Compile a module, or load it from Warp's cache, and say so if that takes a while.

    Where the cache is read-only, full or damaged, a temporary folder takes its place.

    Raises:
        BackendError: it cannot be compiled.
    """
    message = "compiling the distance kernels for %s; this happens once and takes up to 20 s"
    notice = threading.Timer(PATIENCE, logger.warning, (message, device))
    notice.daemon = True
    notice.start()
    try:
        try:
            _make_sure_of_room(module)
            loaded = module.load(wp.device_from_torch(device))
        except Exception as error:  # of any kind, a compiler's
            if _temporary.cache_info().currsize:  # there already
                raise
            _compile_elsewhere(error)
            module.mark_modified()  # what failed once is not tried again otherwise
            _make_sure_of_room(module)
            loaded = module.load(wp.device_from_torch(device))
    except Exception as error:
        message = f"Warp could not compile the distance kernels for {device}: {error}"
        if isinstance(error, OSError):
            message += "; set WARP_CACHE_PATH to a folder with some room, or use another backend ('fcl')"
        raise BackendError(message) from error
    finally:
        notice.cancel()
    if loaded is None:
        raise BackendError(f"Warp could not compile the distance kernels for {device}; use another backend ('fcl')")


def wrap(tensor: Tensor, dtype: Any = None) -> "wp.array":
    """A tensor as a Warp array in place; it must outlive the array."""
    if tensor.numel() == 0:  # the strides of empty tensors are anything
        tensor = torch.zeros(tensor.shape, dtype=tensor.dtype, device=tensor.device)
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def parts_struct(parts: ConvexParts, dtype: torch.dtype, device: torch.device) -> Any:
    """The parts as the kernels read them, made once for each set, dtype and device."""
    structs = _structs.setdefault(parts, {})
    if (dtype, device) not in structs:
        parts = parts.reference  # rounded once, at the end
        s = shapes(REAL[dtype])
        facets, half = parts.facets, 0.5 * (parts.upper - parts.lower)
        lanes, lane_start = _lanes(parts)
        fields = {
            "vertices": (parts.vertices, s.vec3),
            "vertex_start": (parts.vertex_start, None),
            "lanes": (lanes, None),
            "lane_start": (lane_start, None),
            "normals": (facets.normals, s.vec3),
            "offsets": (facets.offsets, None),
            "normal_start": (facets.start, None),
            "edges": (facets.edges, wp.vec4i),
            "edge_start": (facets.edge_start, None),
            "center": (parts.center, s.vec3),
            "half": (half, s.vec3),
            "middle": ((parts.padded * parts.padded_mask[:, :, None]).sum(1) / parts.vertex_count[:, None], s.vec3),
        }
        structs[dtype, device] = fill(s.Parts(), fields, dtype, device)
    return structs[dtype, device]


def fill(struct: Any, fields: dict[str, tuple[Tensor, Any]], dtype: torch.dtype, device: torch.device) -> Any:
    """Set the arrays of a kernel's struct: real ones in ``dtype``, whole numbers in int32. The struct keeps them alive."""
    keep = {}
    for name, (tensor, kind) in fields.items():
        keep[name] = tensor.detach().to(device, dtype if tensor.is_floating_point() else torch.int32).contiguous()
        setattr(struct, name, wrap(keep[name], kind))
    struct.__dict__["_tensors"] = keep
    return struct


def _lanes(parts: ConvexParts) -> tuple[Tensor, Tensor]:
    """The vertices in blocks of ``LANES``, coordinate by coordinate, and each part's first block."""
    count = parts.vertex_count
    blocks = (count + LANES - 1) // LANES
    start = torch.cat([blocks.new_zeros(1), blocks.cumsum(0)])
    part = torch.repeat_interleave(torch.arange(parts.n_parts, device=count.device), blocks)
    within = (torch.arange(len(part), device=count.device) - start[part])[:, None] * LANES
    within = within + torch.arange(LANES, device=count.device)
    index = parts.vertex_start[part, None] + torch.where(within < count[part, None], within, 0)
    return parts.vertices[index].mT.reshape(-1), start


@functools.cache
def wobble_struct(smoothing: Smoothing | None, dtype: torch.dtype, device: torch.device) -> Any:
    """Quadrature of the smoothing as the kernels read it; None: no nodes, no smoothing."""
    nodes, share = torch.zeros(0, 3, dtype=dtype), torch.zeros(0, dtype=dtype)
    s, out = shapes(REAL[dtype]), smooth(REAL[dtype]).Wobble()
    if smoothing is not None:
        nodes, share = smoothing_nodes(smoothing)
        out.noise, out.tangential = smoothing.noise, int(smoothing.kind == "ring")
        # in float32 thinner spreads than this are lost beside long ones
        out.blur = CONTACT_BLUR if dtype == torch.float64 else 10 * CONTACT_BLUR
        out.reach = float(torch.linalg.vector_norm(nodes, dim=1).max())
    return fill(out, {"nodes": (nodes, s.vec3), "share": (share, None)}, dtype, device)


@torch.library.custom_op("physpose_torch::signed_distance", mutates_args=())
def _signed_distance(
    T_a: Tensor,
    T_b: Tensor,
    gradient: bool,
    pairs: Tensor,
    parts: int,
    kind: str,
    noise: float,
    samples: int,
    seed: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    return _run("signed_distances", T_a, T_b, gradient, pairs, parts, _smoothing(kind, noise, samples, seed))


@torch.library.custom_op("physpose_torch::drop_distance", mutates_args=())
def _drop_distance(
    T_a: Tensor,
    T_b: Tensor,
    gradient: bool,
    pairs: Tensor,
    parts: int,
    kind: str,
    noise: float,
    samples: int,
    seed: int,
    gravity: Tensor,
    limit: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    gravity = gravity.detach().contiguous()
    return _run(
        "drop_distances", T_a, T_b, gradient, pairs, parts, _smoothing(kind, noise, samples, seed), gravity, limit
    )


def _run(
    name: str, T_a, T_b, gradient: bool, pairs, parts: int, smoothing: Smoothing | None, *rest
) -> tuple[Tensor, ...]:
    T_a, T_b, pairs = T_a.detach().contiguous(), T_b.detach().contiguous(), pairs.contiguous()
    out = _empty(T_a, gradient)
    if len(pairs) == 0:
        return out
    dtype, device = T_a.dtype, T_a.device
    kernels = ready(pair_kernels, dtype, device)
    s = kernels.s
    rest = [wrap(x, s.vec3) if isinstance(x, Tensor) else x for x in rest]
    inputs = [
        parts_struct(ConvexParts.by_handle(parts), dtype, device),
        wrap(pairs),
        wrap(T_a, s.mat44),
        wrap(T_b, s.mat44),
        wobble_struct(smoothing, dtype, device),
        *rest,
    ]
    kinds = (None, s.vec3, s.vec3, s.vec3, s.mat44, s.mat44)
    outputs = [wrap(x, kind) for x, kind in zip(out, kinds, strict=True)]
    launch(getattr(kernels, name), len(pairs), inputs, outputs, device)
    return out


def launch(kernel: Any, count: int, inputs: list, outputs: list, device: torch.device) -> None:
    """Launch a kernel on the stream that torch is using."""
    stream = wp.stream_from_torch(torch.cuda.current_stream(device)) if device.type == "cuda" else None
    wp.launch(kernel, dim=count, inputs=inputs, outputs=outputs, device=wp.device_from_torch(device), stream=stream)


def _smoothing(kind: str, noise: float, samples: int, seed: int) -> Smoothing | None:
    return None if kind == "none" else Smoothing(kind, noise=noise, samples=samples, seed=seed)


def _empty(T: Tensor, gradient: bool) -> tuple[Tensor, ...]:
    """Room for distances, normals, points and, if asked for, gradients."""
    gradients = (T.new_zeros(len(T) if gradient else 0, 4, 4) for _ in range(2))
    return T.new_zeros(len(T)), *(T.new_zeros(len(T), 3) for _ in range(3)), *gradients


def _fake(T_a: Tensor, T_b: Tensor, gradient: bool, *_) -> tuple[Tensor, ...]:
    return _empty(T_a, gradient)


for _op in (_signed_distance, _drop_distance):
    _op.register_fake(_fake)


class _Distance(torch.autograd.Function):
    """An operator's distances; it has worked out their gradient as well."""

    @staticmethod
    def forward(ctx, T_a, T_b, operator, *rest):
        wanted = ctx.needs_input_grad[0] or ctx.needs_input_grad[1]
        distance, normal, point_a, point_b, *gradients = operator(T_a, T_b, wanted, *rest)
        ctx.save_for_backward(*gradients)
        ctx.mark_non_differentiable(normal, point_a, point_b)
        ctx.n_rest = len(rest)
        return distance, normal, point_a, point_b

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_distance, *_):
        weight = grad_distance[:, None, None]
        return *(weight * gradient for gradient in ctx.saved_tensors), None, *([None] * ctx.n_rest)


def warp_distance(
    T_a: Tensor, T_b: Tensor, parts: ConvexParts, pairs: Tensor, smoothing: Smoothing | None
) -> DistanceResult:
    """See :func:`physpose_torch.distance.autograd.signed_distance`; computed in the poses' dtype and on their device."""
    arguments = (pairs.to(T_a.device), parts.handle, *_plain(smoothing))
    return DistanceResult(*_Distance.apply(T_a, T_b, _signed_distance, *arguments))


def warp_drop(
    T_a: Tensor,
    T_b: Tensor,
    parts: ConvexParts,
    pairs: Tensor,
    gravity: Tensor,
    limit: float,
    smoothing: Smoothing | None,
) -> DistanceResult:
    """See :func:`physpose_torch.distance.autograd.drop_distance`; computed in the poses' dtype and on their device."""
    gravity = gravity.to(T_a)
    arguments = (pairs.to(T_a.device), parts.handle, *_plain(smoothing), gravity, limit)
    out = DistanceResult(*_Distance.apply(T_a, T_b, _drop_distance, *arguments))
    if not gravity.requires_grad:
        return out
    # h = gap / (n·g), so ∂h/∂g = -h n / (n·g)
    rate = (out.normal * gravity.detach()).sum(-1)
    height = out.distance.detach()
    slope = torch.where(height.isfinite() & (rate > 0), -height / rate.clamp_min(1e-300), 0.0)[:, None] * out.normal
    linear = (slope * gravity).sum(-1)
    return out._replace(distance=out.distance + (linear - linear.detach()))


def _plain(smoothing: Smoothing | None) -> tuple[str, float, int, int]:
    s = smoothing or Smoothing("none")
    return s.kind, s.noise, s.samples, s.seed


def warp_query(parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Exact distances as :func:`physpose_torch.distance.fcl.fcl_distance` gives them, for smoothing done elsewhere."""
    T_b = se3.from_rotation_translation(R, t)
    return warp_distance(torch.eye(4).to(T_b).expand_as(T_b), T_b, parts, pairs, None)
