"""Several processes that learn one model, one for each GPU, started by torchrun; alone, all of this does nothing.

Statistics of a batch, averages of gradients and decisions of the loop go through here, so that n processes with a part
of the batch each learn what one process learns from all of it. Tensors on a GPU are reduced by NCCL, also inside a
captured CUDA graph; those on the CPU by gloo.
"""

from __future__ import annotations

import os
import socket
import sys
import time
import uuid
from collections.abc import Iterable, Mapping, Sequence
from datetime import timedelta
from multiprocessing import util
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, distributed

from franka_wm.errors import UserError

TIMEOUT = timedelta(minutes=30)
"""How long a process waits for another one that lives: it may compile kernels, or write a large checkpoint."""

LAST_WORDS = 1.0
"""So long does the first process outlive what it refuses [s]: others that refuse the same ask its store who says so."""

LOST_STATUS = 75
"""Exit status of a process that has lost another one, whose launcher says so: none of those of errors."""

PIECE = 2**20
"""So much of the weights is compared at once [bytes]."""
_WHOLE = {1: torch.uint8, 2: torch.int16, 4: torch.int32, 8: torch.int64}
"""Size of an entry [bytes] → whole numbers of that size."""

SEEN = ".seen"
SOON = 90.0
"""After so long every host sees what one has written to a disk of the network [s]."""

MEETING = timedelta(minutes=10)
"""How long a process waits at the start for the others, which are started at the same time."""


def restarted() -> bool:
    """Whether the job was started anew: by torchrun after a process had died, or by SLURM, which requeued it."""
    return begun_again() or requeued()


def by_torchrun() -> bool:
    """Whether torchrun has started this process, which it may do again."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def requeued() -> bool:
    """Whether SLURM has requeued the job."""
    return int(os.environ.get("SLURM_RESTART_COUNT") or 0) > 0


def begun_again() -> bool:
    """Whether torchrun has started the processes of the job anew; one alone does not meet others, who would tell."""
    alone = by_torchrun() and os.environ.get("WORLD_SIZE") == "1"
    return _anew or (alone and int(os.environ.get("TORCHELASTIC_RESTART_COUNT") or 0) > 0)


_anew = False


def count() -> int:
    """How many processes learn together."""
    return distributed.get_world_size() if _joined() else 1


def rank() -> int:
    """The number of this process, from 0."""
    return distributed.get_rank() if _joined() else 0


def parts() -> tuple[int, ...]:
    """What tells the seeds of several processes apart; nothing where there is one."""
    return (rank(),) if count() > 1 else ()


def own_part(whole: int, block: int = 1) -> tuple[int, int]:
    """The first of this process's share of ``whole`` things, and how many they are; blocks stay together.

    Shares differ by one block at most, and the last one may be cut. There may be fewer things than processes.
    """
    each, more = divmod(-(-whole // block), count())
    first, after = (min(whole, block * (k * each + min(k, more))) for k in (rank(), rank() + 1))
    return first, after - first


def is_first() -> bool:
    """Whether this process is the one that speaks and writes for all."""
    return rank() == 0


def join(*, cuda: bool) -> None:
    """Meets the other processes that torchrun has started, and takes this one's GPU of the host.

    Raises:
        UserError: The others cannot be met, or a host has fewer GPUs than processes; all processes raise the latter.
    """
    from torch.distributed.rendezvous import rendezvous

    global _anew
    address = f"{os.environ.get('MASTER_ADDR')}:{os.environ.get('MASTER_PORT')}"
    try:
        store, rank, size = next(rendezvous("env://", timeout=MEETING))
        store.set_timeout(MEETING)
        lacks = _told(store, rank, size, _lack_of_gpus() if cuda else "")
        if lacks:
            raise UserError(lacks)
        if cuda:
            torch.cuda.set_device(own_gpu())
        backend = "cpu:gloo,cuda:nccl" if cuda else "gloo"
        distributed.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=MEETING)
        # Of several hosts, that whose process died alone counts it.
        _anew = any(objects(int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")) > 0))
        if cuda:
            distributed.all_reduce(torch.zeros(1, device=own_gpu()))  # NCCL connects at the first one
            torch.cuda.synchronize()
    except RuntimeError as error:
        why = str(error).splitlines()[0][:120]
        if isinstance(error, torch.OutOfMemoryError) or "CUDA error" in why:
            raise
        host = socket.gethostname()
        raise UserError(
            f"process {os.environ['RANK']} on {host} cannot meet the others at {address} ({why}); check that all hosts "
            "reach it, and name the interface between them by GLOO_SOCKET_IFNAME and NCCL_SOCKET_IFNAME"
        ) from error
    store.set_timeout(TIMEOUT)
    distributed.distributed_c10d._set_pg_timeout(TIMEOUT)


def _lack_of_gpus() -> str:
    """What is wrong with this host, which has fewer GPUs than processes; nothing where it has enough."""
    there = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if int(os.environ["LOCAL_RANK"]) < there:
        return ""
    return (
        f"host {socket.gethostname()} has {there} usable CUDA devices for {os.environ['LOCAL_WORLD_SIZE']} processes; "
        "start fewer processes there, leave the host out, or use device=cpu for all"
    )


def _told(store: Any, rank: int, size: int, mine: str) -> str:
    """The first of what all processes say that is not empty; they need not have a process group yet."""
    store.set(f"said by {rank}", mine)
    found = [store.get(f"said by {k}").decode() for k in range(size)]
    store.set(f"heard by {rank}", "")
    if rank == 0:  # it may keep the store, which ends with it
        store.wait([f"heard by {k}" for k in range(size)])
    return next(filter(None, found), "")


def leave(status: int = 0) -> None:
    """Ends this process where it is one of several; alone it does nothing.

    Parting in order would wait: a captured graph holds NCCL's connections, and threads those of gloo.
    """
    if _joined():
        sys.stdout.flush()
        sys.stderr.flush()
        if status in (1, LOST_STATUS) and is_first():
            time.sleep(LAST_WORDS)
        util._run_finalizers(0)  # semaphores of the replay, of which Python would tell as leaked  # pyright: ignore
        os._exit(status)


def own_gpu() -> torch.device:
    """The GPU of this host that is this process's."""
    return torch.device("cuda", int(os.environ["LOCAL_RANK"]))


def speaks_first() -> bool:
    """Whether no process of this host has said before why it ends; the first to ask is told so, once.

    Before they have met, the first process of each host is.
    """
    if not _joined():
        return os.environ.get("LOCAL_RANK", "0") == "0"
    store = distributed.distributed_c10d._get_default_store()
    restart, host = (os.environ.get(name, "0") for name in ("TORCHELASTIC_RESTART_COUNT", "GROUP_RANK"))
    try:
        return store.add(f"ends {restart} on {host}", 1) == 1
    except RuntimeError:  # the one who keeps the store is gone: then nobody else can have heard
        return True


# -- statistics of all processes' batches ------------------------------------------------------------------------


def mean(x: Tensor) -> Tensor:
    """Mean of `x` over all processes; the gradient goes back to every one of them."""
    return x if count() == 1 else _applied(_Mean, x)  # pyright: ignore[reportCallIssue]


def means(*tensors: Tensor) -> tuple[Tensor, ...]:
    """:func:`mean` of tensors of one shape in one message: what a small one costs is the waiting."""
    return tensors if count() == 1 else mean(torch.stack(tensors)).unbind()


@torch.compiler.disable
def _applied(function: type[torch.autograd.Function], x: Tensor) -> Tensor:
    """Outside of what ``torch.compile`` makes of a loss."""
    return function.apply(x)  # pyright: ignore[reportReturnType]


class _Mean(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return _averaged(x)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return _averaged(grads[0])


def gather(x: Tensor) -> Tensor:
    """`x` (n, …) of every process, one behind the other; the gradient goes back to every one of them."""
    return x if count() == 1 else _applied(_Gather, x)  # pyright: ignore[reportCallIssue]


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        x = x.detach().contiguous()
        whole = x.new_empty(count() * len(x), *x.shape[1:])
        _together(lambda: distributed.all_gather_into_tensor(whole, x))
        return whole

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        total = grads[0].contiguous().clone()
        _together(lambda: distributed.all_reduce(total))
        return total.chunk(count())[rank()]


def broadcast(x: Tensor) -> Tensor:
    """`x` of the first process, in place."""
    if count() > 1:
        _together(torch.compiler.disable(lambda: distributed.broadcast(x, 0)))
    return x


@torch.no_grad()
def average_gradients(parameters: Iterable[Tensor]) -> None:
    """Averages the gradients of all processes, in one large message."""
    if count() == 1:
        return
    grads = [p.grad for p in parameters if p.grad is not None]
    flat = _mean_of(torch.cat([g.flatten() for g in grads]))
    parts = [part.view_as(g) for part, g in zip(flat.split([g.numel() for g in grads]), grads, strict=True)]
    torch._foreach_copy_(grads, parts)  # pyright: ignore[reportPrivateImportUsage]


def pooled(mean: Tensor, std: Tensor, samples: int) -> tuple[Tensor, Tensor]:
    """Mean and unbiased deviation of all processes' samples, from those of each, of so many samples."""
    means, deviations = gather(mean.unsqueeze(0)), gather(std.unsqueeze(0))
    counts = gather(mean.new_full((1, *[1] * mean.dim()), samples))
    whole = (counts / counts.sum() * means).sum(0)
    squares = (counts - 1) * deviations.square() + counts * (means - whole).square()
    return whole, (squares.sum(0) / (counts.sum() - 1).clamp_min(1)).sqrt()


# -- the loop ----------------------------------------------------------------------------------------------------


def agree(any_of: Sequence[bool], first_of: Sequence[bool]) -> list[bool]:
    """Decisions that all processes take alike: true if it is true for any of them, then: for the first one.

    What depends on clocks and signals differs between processes; waiting for one that went another way would never end.
    """
    mine = [*any_of, *(one and is_first() for one in first_of)]
    if count() == 1:
        return mine
    flags = torch.tensor(mine, dtype=torch.int32)
    _together(lambda: distributed.all_reduce(flags, distributed.ReduceOp.MAX))
    return flags.bool().tolist()


def objects(mine: object) -> list[Any]:
    """Something small of every process, in their order."""
    found: list[Any] = [None] * count()
    if count() == 1:
        return [mine]
    _together(lambda: distributed.all_gather_object(found, mine))
    return found


def wait() -> None:
    """Until all processes are here."""
    if count() > 1:
        agree([False], [])


def require_seen(folder: Path, option: str) -> None:
    """Checks that every process of the job sees what the first one writes into a folder, which ``option`` names.

    Raises:
        UserError: One does not.
    """
    if count() == 1:
        return
    mark = folder / SEEN
    token = objects(uuid.uuid4().hex)[0]
    if is_first():
        mark.write_text(token)
    wait()
    until = time.monotonic() + SOON
    while not (seen := mark.is_file() and mark.read_text() == token) and time.monotonic() < until:
        time.sleep(0.1)
    blind = [rank for rank, one in enumerate(objects(seen)) if not one]
    if is_first():
        mark.unlink()
    if blind:
        raise UserError(f"rank {blind[0]} does not see {folder}: give {option} on a disk that all hosts see")


def require_same(state: Mapping[str, Any]) -> None:
    """Checks that the weights of all processes are the same, bit for bit; waits for the device.

    Args:
        state: A module's ``state_dict()``; entries that are no tensors are left out.

    Raises:
        UserError: They are not; names the first that differ.
    """
    if count() == 1:
        return
    tensors = {name: x for name, x in state.items() if isinstance(x, Tensor)}
    sums = torch.stack([_hash(x) for x in tensors.values()]).cpu()
    found = objects(sums)
    for other, theirs in enumerate(found):
        different = [
            name for name, same in zip(tensors, (theirs == found[0]).tolist(), strict=True) if not same
        ]
        if different:
            raise UserError(
                f"the weights of process {other} are no longer those of process 0 (first {different[0]}, "
                f"{len(different)} in all); go on from the last checkpoint, and report it with the command"
            )


def _hash(x: Tensor) -> Tensor:
    """A whole number (,) in which each entry of a tensor has a weight of its own, so that exchanges are seen.

    By pieces: whole numbers of 64 bits for all entries would take twice the memory of the weights, and more.
    """
    found = torch.zeros((), dtype=torch.int64, device=x.device)
    weights = torch.arange(1, PIECE + 1, device=x.device)
    size = x.element_size()
    for piece in x.detach().reshape(-1).view(_WHOLE.get(size, torch.uint8)).split(PIECE // size):
        found = found * 1_000_003 + (weights[: len(piece)] * piece).sum()  # odd: what differs stays different
    return found


def _joined() -> bool:
    return distributed.is_available() and distributed.is_initialized()


def _averaged(x: Tensor) -> Tensor:
    return _mean_of(x.detach().clone(memory_format=torch.contiguous_format))


def _mean_of(total: Tensor) -> Tensor:
    """The mean over all processes; adds them up in place.

    Not by NCCL's own mean, which multiplies by 1 / n: for twelve ones that is not one.
    """
    _together(lambda: distributed.all_reduce(total))
    return total / count()


def _together(what: Any) -> None:
    try:
        what()
    except RuntimeError as error:
        if isinstance(error, torch.OutOfMemoryError) or "CUDA error" in str(error):
            raise
        why = str(error).splitlines()[0][:120]
        raise LostAnother(
            f"process {os.environ.get('RANK', 0)} has lost another one of this run ({why}); what was saved is whole"
        ) from error


class LostAnother(UserError):
    """Another process of the job has ended, or cannot be reached. Who has started both says more, if we have."""
