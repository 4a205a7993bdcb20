"""Where the kernels' machine code is kept, and whether it is there; knows nothing of numba.

A process that compiles for itself adds up in another order here and there than one that reads
what was compiled before (the compiler may reorder sums, and links what it has at hand): the same
measurements give estimates that differ in the last digits. So that a replay gives a session's
estimates to the last byte, whoever needs kernels has them compiled by processes of their own first,
as many as there are processors.
"""

from __future__ import annotations

import atexit
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from relpos.fusion.kernel_types import LATER, OF

SOURCES = Path(__file__).parent

MOST_PROCESSES = 4
"""The longest kernel takes a third of all the time, and each process half a gigabyte."""


def modules_of(kernels: Iterable[str]) -> tuple[str, ...]:
    """Give the modules of kernels, sorted."""
    return tuple(sorted({kernel.split(".")[0] for kernel in kernels}))


KERNELS = modules_of(kernel for kernels in OF.values() for kernel in kernels)
"""Modules with kernels that every session needs (``fusion.warm_up``)."""


def folders(told: str | None) -> list[Path]:
    """Where numba keeps it: as ``told`` (NUMBA_CACHE_DIR), by the source, in the user's cache."""
    if told:
        return [Path(told)]
    from platformdirs import user_cache_path

    return [SOURCES / "__pycache__", user_cache_path("numba", appauthor=False)]


def changed_s(modules: Iterable[str] = KERNELS) -> float:
    """When any of the modules, or of those of this folder that they import, was last changed.

    A kernel has what it calls, and others' constants, compiled into it; numba looks at its own
    file alone.
    """
    newest_s, seen, waiting = 0.0, set(), list(modules)
    while waiting:
        module = waiting.pop()
        source = SOURCES / f"{module}.py"
        if module in seen or not source.is_file():
            continue
        seen.add(module)
        newest_s = max(newest_s, source.stat().st_mtime)
        for names in _IMPORTED.findall(source.read_text(encoding="utf-8")):
            waiting += [name for part in names if part for name in re.findall(r"\w+", part)]
    return newest_s


_IMPORTED = re.compile(r"^from relpos\.fusion(?:\.(\w+) import| import (.+))", re.MULTILINE)


def _indices(places: Iterable[Path], modules: Collection[str]) -> Iterator[tuple[str, Path]]:
    """Each module's files that tell what is kept."""
    suffix = f".py{sys.version_info.major}{sys.version_info.minor}.nbi"
    for place in places:
        for file in place.rglob(f"*{suffix}"):
            module = file.name.split(".")[0]
            if module in modules:
                yield module, file


def is_kept(places: Sequence[Path], modules: Collection[str] = KERNELS) -> bool:
    """Whether every module's kernels have been compiled since any of them was last changed."""
    since_s = changed_s(modules)
    newest = dict.fromkeys(modules, -1.0)
    for module, file in _indices(places, modules):
        newest[module] = max(newest[module], file.stat().st_mtime)
    return all(compiled_s >= since_s for compiled_s in newest.values())


def forget(places: Sequence[Path], modules: Collection[str] = KERNELS) -> None:
    """Have numba compile anew what was compiled before the last change."""
    since_s = changed_s(modules)
    for _, file in list(_indices(places, modules)):
        with suppress(OSError):
            if file.stat().st_mtime < since_s:
                file.unlink()


def compile_apart(estimators: Collection[str] = tuple(OF)) -> None:
    """Have the estimators' kernels compiled by other processes, where they are not kept yet.

    What a team may yet grow into is compiled after that, while the session has begun. Where no
    folder can be written they are kept until this process ends. Where the others fail, this
    process will compile for itself.
    """
    kernels = [kernel for name in estimators for kernel in OF[name]]
    places = folders(os.environ.get("NUMBA_CACHE_DIR"))
    if is_kept(places, modules_of(kernels)):
        return
    forget(places, modules_of(kernels))
    later = [kernel for name in estimators for kernel in LATER.get(name, ())]
    if not any(_may_write(place) for place in places):
        os.environ["NUMBA_CACHE_DIR"] = folder = tempfile.mkdtemp(prefix="relpos-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        later = []
    _compile(kernels, [f"rehearse {name}" for name in estimators], later)


def _may_write(place: Path) -> bool:
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            return True
    except OSError:
        return False


_AT_WORK: list[_Compiler] = []
"""Those that nobody waits for."""


class _Compiler:
    """One process that compiles what it is told (:mod:`relpos.fusion.compiling`)."""

    def __init__(self) -> None:
        # Its texts of failed rules would be coloured, all of them, though nobody reads them.
        plain = {"NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1", "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [sys.executable, "-c", "from relpos.fusion import compiling; compiling.work()"],
            env=os.environ | plain,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip

    def do(self, job: str) -> bool:
        """Wait until a job is done; tell whether it was."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with suppress(OSError):
            print(job, file=self.process.stdin, flush=True)
            return self.process.stdout.readline() != ""
        return False

    def work_off(self, jobs: deque[str]) -> None:
        """Do jobs until there are none left, or this process cannot."""
        with suppress(IndexError):
            while self.do(jobs.popleft()):
                pass

    def go_on(self, jobs: Sequence[str]) -> None:
        """Let it do jobs by itself, and end."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with suppress(OSError):
            self.process.stdin.writelines(f"{job}\n" for job in jobs)
            self.process.stdin.close()
        self.process.stdout.close()
        _AT_WORK.append(self)

    def end(self) -> None:
        """Leave nothing behind."""
        self.process.kill()
        self.process.communicate()


def _compile(kernels: Sequence[str], rehearsals: Sequence[str], later: Sequence[str]) -> None:
    jobs = deque(kernels)
    compilers: list[_Compiler] = []
    try:
        with suppress(OSError):
            while len(compilers) < min(_processors(), MOST_PROCESSES, max(len(kernels), 1)):
                compilers.append(_Compiler())
        threads = [threading.Thread(target=c.work_off, args=(jobs,)) for c in compilers]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for rehearsal in rehearsals:
            any(c.do(rehearsal) for c in compilers)
        if later and compilers:
            compilers.pop(0).go_on(later)
    finally:
        for one in compilers:
            one.end()


def _processors() -> int:
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
