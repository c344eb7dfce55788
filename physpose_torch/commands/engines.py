"""Where the batches of ``physpose refine`` are refined: in this process, or by the workers of a Ray cluster."""

import contextlib
import functools
import json
import logging
import os
import signal
import threading
import traceback
import warnings
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from physpose_torch import __version__
from physpose_torch.commands.batches import Batch, BatchRefiner, lost_batch
from physpose_torch.errors import BackendError, DataError, MissingExtraError, PhysPoseError

__all__ = ["refine_here", "refine_on_ray"]

ATTEMPTS = 4
"""Times that a batch is begun, if its worker dies."""
CACHES = ("PHYSPOSE_CACHE", "WARP_CACHE_PATH")
logger = logging.getLogger("physpose_torch")


def refine_here(refine: BatchRefiner, batches: Sequence[np.ndarray]) -> Generator[Batch, None, None]:
    """Refine batches, numbers of images each, one after another in this process."""
    yield from map(refine, batches)


def refine_on_ray(
    refine: BatchRefiner, batches: Sequence[np.ndarray], *, workers: int | None = None
) -> Generator[Batch, None, None]:
    """Refine batches, numbers of images each, on a Ray cluster by Ray Data; they come back in order.

    Every core takes the next batch when it is done with one. A batch whose worker dies is done again elsewhere; what kills
    its worker time and again is left alone, and its images say so.

    The cluster is that of ``RAY_ADDRESS``, or one that runs on this machine, or else this machine's cores. Its machines must
    find the files under the same paths, and have the same version of this package.

    Args:
        workers: batches at a time; None: one a core of the cluster.

    Raises:
        MissingExtraError: Ray is not installed.
        BackendError: the cluster cannot be reached, or its workers lack this package.
        DataError: a worker does not find the files, or the result file was changed.
    """
    ray = _ray()
    if not len(batches):
        return
    own = not ray.is_initialized()
    if own:
        _start(ray)
    try:
        # in a list, for an argument itself would be read anew for every batch
        attempts = ray.remote(num_cpus=0, max_restarts=-1, max_task_retries=-1)(_Attempts).remote()
        payload = [ray.put((refine, list(batches)))]
        job = _Job(__version__, os.getcwd(), {k: os.environ[k] for k in CACHES if k in os.environ}, attempts, payload)
        _check_nodes(ray, job)
        told: set[str] = set()
        for row in _rows(ray, job, len(batches), workers):
            found = json.loads(row["found"])
            for message in found["messages"]:
                if message not in told:  # every worker says so once
                    logger.warning("%s", message)
                    told.add(message)
            if "error" in found:
                raise DataError(found["error"])
            if "batch" in found:
                yield Batch(*found["batch"])
            else:
                names = refine.index.names(batches[row["number"]])
                yield lost_batch(names, f"killed its worker {ATTEMPTS} times; try --engine local")
    finally:
        if own:
            ray.shutdown()


class _Job(NamedTuple):
    """What workers need to know."""

    version: str
    folder: str
    """In which paths are meant."""
    caches: dict[str, str]
    """Environment variables."""
    attempts: Any
    """An actor, :class:`_Attempts`."""
    payload: list
    """Reference to (refiner, batches)."""


class _Attempts:
    """Counts how often each batch was begun, for Ray begins it anew as often as its worker dies."""

    def __init__(self) -> None:
        self.begun = Counter()

    def begin(self, number: int) -> int:
        self.begun[number] += 1
        return self.begun[number]


def _ray() -> Any:
    """The package, told not to report home."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # else it warns of a change to come
    try:
        import ray
        import ray.data
    except ImportError as error:
        raise MissingExtraError(f"--engine ray: {error}; pip install 'physpose-torch[ray]'") from None
    return ray


def _start(ray: Any) -> None:
    before = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(include_dashboard=False, logging_level=logging.ERROR, log_to_driver=False)
    except Exception as error:
        where = os.environ.get("RAY_ADDRESS", "on this machine")
        raise BackendError(f"--engine ray: the cluster {where} cannot be used ({error}); check RAY_ADDRESS") from None
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)  # Ray's ends the process without a word


def _check_nodes(ray: Any, job: _Job) -> None:
    """Every machine can do the work: Ray would try for ever."""
    on = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
    make_ready = ray.remote(num_cpus=0, max_retries=0)(_make_ready)
    nodes = [n for n in ray.nodes() if n["Alive"] and n["Resources"].get("CPU")]
    answers = [make_ready.options(scheduling_strategy=on(n["NodeID"], soft=False)).remote(job) for n in nodes]
    for node, answer in zip(nodes, answers, strict=True):
        try:
            ray.get(answer)
        except ray.exceptions.RayError as error:
            remedy = f"install physpose-torch {__version__} there as here"
            raise BackendError(f"--engine ray: {node['NodeManagerAddress']} cannot refine ({_why(error)}); {remedy}") from None


def _why(error: Exception) -> str:
    """The last line of what a worker said."""
    return ("\n" + str(getattr(error, "cause", error)).strip()).splitlines()[-1] or type(error).__name__


def _rows(ray: Any, job: _Job, count: int, workers: int | None) -> Iterator[dict[str, Any]]:
    """A row for each batch: its number, and what became of it."""
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    context = ray.data.DataContext.get_current()
    context.enable_progress_bars = context.print_on_execution_start = False
    context.execution_options.preserve_order = True
    # or else of two cores one is kept for making numbers, and every batch waits until a worker is found
    context.op_resource_reservation_enabled = False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Ray is going to manage that by itself
        context.scheduling_strategy = "DEFAULT"
    numbers = ray.data.range(count, override_num_blocks=count)
    compute = ray.data.TaskPoolStrategy(workers)
    found = numbers.map_batches(_refine_on_worker, batch_size=1, fn_kwargs={"job": job}, num_cpus=1, compute=compute)
    try:
        yield from found.iter_rows()
    except ray.exceptions.RayError as error:
        raise BackendError(f"--engine ray: {_why(error)}; --resume goes on, with another --engine, too") from error


def _refine_on_worker(row: dict[str, np.ndarray], *, job: _Job) -> dict[str, list]:
    """ "number", and "found", JSON: "messages" of the worker and "batch", a :class:`Batch`, or "error", what is wrong with a
    file; neither where too many workers died of it."""
    import ray

    number, found = int(row["id"][0]), {}
    with _messages() as found["messages"]:
        begun = ray.get(job.attempts.begin.remote(number))
        if begun > 1:
            logger.warning("a worker died; batch %d is begun again", number)
        try:
            if begun <= ATTEMPTS:
                refine, batches = _make_ready(job)
                found["batch"] = refine(batches[number])
        except DataError as error:
            found["error"] = str(error)
        except Exception as error:  # Ray would bury it
            if not isinstance(error, PhysPoseError | OSError):
                logger.warning("%s", traceback.format_exc())
            found["error"] = f"--engine ray, on {ray.util.get_node_ip_address()}: {error}"
    return {"number": [number], "found": [json.dumps(found)]}


@contextlib.contextmanager
def _messages() -> Iterator[list[str]]:
    """What is logged and warned of meanwhile, for whoever watches is elsewhere."""
    caught: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: caught.append(record.getMessage())
    logger.addHandler(handler)
    try:
        with warnings.catch_warnings(record=True) as warned:
            yield caught
    finally:
        caught += [str(w.message) for w in warned if w.category is UserWarning]
        logger.removeHandler(handler)


def _make_ready(job: _Job) -> tuple[BatchRefiner, list[np.ndarray]]:
    """Get a worker ready, once for all its batches."""
    if job.version != __version__:
        raise BackendError(f"it has physpose-torch {__version__}")
    if os.path.isdir(job.folder):
        os.chdir(job.folder)
    os.environ |= job.caches
    torch.set_num_threads(1)
    return _opened(job.payload[0])


@functools.lru_cache(maxsize=1)
def _opened(payload: Any) -> tuple[BatchRefiner, list[np.ndarray]]:
    import ray

    return ray.get(payload)
