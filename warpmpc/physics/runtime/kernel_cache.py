# SPDX-License-Identifier: Apache-2.0
"""Warp's compiled kernels on disk: a checksum beside each, damaged ones are built again, bad folders are named.

Kernels that all scenes share and that come compiled in the wheel, so that a first run need not compile them.

They are for one version of Warp and a level of processors that nearly all reach. With any other, in a checkout, and
where their text has changed they are compiled as any other kernel.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import tempfile
import threading
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import warp as wp
from warp._src import context
from warp._src.context import Runtime

LEVELS = {"x86_64": ("-target-cpu x86-64-v3", {"avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"})}
"""Compiler flags for object files that run on more than this machine, and what a processor must have for them."""


def flags() -> str:
    """Compiler flags of the object files for this kind of machine."""
    return LEVELS.get(platform.machine(), ("", set()))[0]


def home() -> Path:
    """Folder of object files, there or not; the environment variable ``WARPMPC_KERNELS`` moves it."""
    return Path(os.environ.get("WARPMPC_KERNELS") or Path(__file__).with_name("objects"))


def target() -> str:
    """Name of the folder of object files for this version of Warp, its compiler and this kind of machine."""
    return f"{wp.__version__}-{context._get_cpu_target_hash(flags())}"


@cache
def _folder(home: Path) -> Path | None:
    """Folder of object files that this processor can run, None where there is none."""
    needed = LEVELS.get(platform.machine(), ("", set()))[1]
    folder = home / target()
    return folder if folder.is_dir() and needed <= set(context._get_cpu_feature_set() or ()) else None


def shipped(module: wp.Module, block_dim: int) -> tuple[Path, Path] | None:
    """Object file of a module on the CPU and its content as JSON, if it comes compiled as it is now."""
    folder = _folder(home())
    if folder is None:
        return None
    name = module.get_module_identifier(block_dim)
    code, meta = folder / f"{name}.o", folder / f"{name}.meta"
    return (code, meta) if code.is_file() and meta.is_file() else None


_ROOM = 1 << 20
"""Bytes that a folder must take before a compiler writes there, which may end the process where it cannot."""
_ELF = b"\x7fELF"
_load = wp.Module.load
_own_headers = Runtime.get_clang_pch_dir
"""Warp's own."""
_loading: dict[str, threading.RLock] = {}
"""Held by module while it is loaded: other threads wait for it in place of compiling it again."""


@dataclass(frozen=True)
class Cached:
    """Files of a module for one device; Warp tells their names by no public function."""

    code: Path
    """Object code, or a program of a GPU."""
    meta: Path
    """Content, as JSON."""

    @classmethod
    def of(cls, module: wp.Module, device: wp.Device, block_dim: int) -> Cached:
        """Folder in which Warp keeps a module, there or not."""
        folder = Path(wp.config.kernel_cache_dir) / module.get_module_identifier(block_dim)
        code = folder / module._get_compile_output_name(device, block_dim=block_dim)
        return cls(code, folder / module._get_meta_name(block_dim=block_dim))

    @property
    def _told(self) -> Path:
        return self.code.with_name(f"{self.code.name}.sha256")

    def _sum(self, code: bytes) -> str:
        """The checksum in the format of ``sha256sum``."""
        return f"{hashlib.sha256(code).hexdigest()}  {self.code.name}\n"

    def intact(self) -> bool:
        """Return whether the files are there as they were written; without a checksum, whether they look whole."""
        try:
            code = self.code.read_bytes()
            json.loads(self.meta.read_bytes())
            return self._told.read_text() == self._sum(code) if self._told.exists() else _whole(code)
        except (OSError, ValueError):
            return False

    def sign(self) -> None:
        """Write the checksum, unless it is there or the folder takes none."""
        if self._told.exists():
            return
        with suppress(OSError):
            part = self._told.with_name(f"{self._told.name}.{os.getpid()}")
            part.write_text(self._sum(self.code.read_bytes()))
            part.replace(self._told)

    def discard(self) -> None:
        """Delete the files, so that Warp builds them again.

        Raises:
            OSError: If the folder cannot be changed.
        """
        try:
            for file in (self.code, self.meta, self._told):
                file.unlink(missing_ok=True)
        except OSError as error:
            raise refusal(error) from error


def ready(module: wp.Module, device: wp.Device, block_dim: int) -> bool:
    """Return whether a module need not be compiled."""
    return bool(device.is_cpu and shipped(module, block_dim)) or Cached.of(module, device, block_dim).intact()


def refusal(error: OSError) -> OSError:
    """The error for a folder of kernels that cannot be made or written."""
    folder, why = wp.config.kernel_cache_dir, error.strerror or error
    return OSError(f"compiled kernels cannot be kept in {folder}: {why}; make room there, or set WARP_CACHE_PATH")


def watch() -> None:
    """Look at what is loaded from Warp's folder from now on, by any library of this process; keep headers there.

    Warp's line for every module that it loads is left out, unless ``wp.config.log_level`` is set back afterwards.
    """
    if wp.config.log_level == wp.LOG_INFO:  # as it is by default
        wp.config.log_level = wp.LOG_WARNING
    wp.Module.load = _checked
    Runtime.get_clang_pch_dir = _headers


def _headers(runtime: Runtime) -> str | None:
    """Folder of the headers that every source begins with, compiled, which takes longer than most kernels.

    Warp makes them anew in every thread of every process. It writes them under another name first, and makes those
    that are damaged again. They are read with the headers themselves, which are gone with an environment that is
    deleted, and of another time in one that is made anew: every installation of Warp has a separate folder.
    """
    if runtime.llvm is None or not wp.config.cache_kernels:
        return _own_headers(runtime)
    warp = Path(wp.__file__).parent
    place = hashlib.sha256(str(warp).encode()).hexdigest()[:12]
    all_headers = Path(wp.config.kernel_cache_dir) / "headers"
    try:
        folder = all_headers / f"{place}-{(warp / 'native' / 'builtin.h').stat().st_mtime_ns}"
        if not folder.exists():
            for former in all_headers.glob(f"{place}-*"):
                shutil.rmtree(former, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # compiling gets the error
        return _own_headers(runtime)
    return str(folder)


def _checked(
    module: wp.Module,
    device: wp.DeviceLike,
    block_dim: int | None = None,
    binary_path: os.PathLike | None = None,
    **rest: object,
) -> object:
    """``wp.Module.load`` with a look at the files before and a checksum after.

    Raises:
        OSError: If the module must be built and the folder cannot be written.
    """
    device = wp.get_device(device)
    threads = module.options["block_dim"] if block_dim is None else block_dim
    if binary_path is not None or not wp.config.cache_kernels or (device.context, threads) in module.execs:
        return _load(module, device, block_dim, binary_path, **rest)
    with _loading.setdefault(module.name, threading.RLock()):
        return _load_checked(module, device, block_dim, threads, **rest)


def _load_checked(module: wp.Module, device: wp.Device, block_dim: int | None, threads: int, **rest: object) -> object:
    """Load a module that is not loaded yet.

    Raises:
        OSError: As :func:`_checked`.
    """
    if device.is_cpu and (files := shipped(module, threads)):
        with suppress(Exception):  # it is damaged
            return _load(module, device, block_dim, files[0], meta_path=files[1])
    cached = Cached.of(module, device, threads)
    kept = cached.intact()
    if not kept:
        cached.discard()
        _require_room()
    try:
        loaded = _load(module, device, block_dim, **rest)
    except OSError as error:
        raise refusal(error) from error
    except Exception:
        if not kept:
            raise
        cached.discard()  # it looked well and is not
        _require_room()
        loaded = _load(module, device, block_dim, **rest)
    cached.sign()
    return loaded


def _require_room() -> None:
    """Refuse a folder that cannot be written.

    Raises:
        OSError: If it cannot.
    """
    try:
        with tempfile.TemporaryFile(dir=wp.config.kernel_cache_dir) as file:
            file.write(bytes(_ROOM))
    except OSError as error:
        raise refusal(error) from error


def _whole(code: bytes) -> bool:
    """Return whether an object file ends where its header says, or a GPU program is no object file and not empty."""
    if not code.startswith(_ELF):
        return b".version" in code[:4096]  # PTX
    at, size, count = (int.from_bytes(code[i:j], "little") for i, j in ((40, 48), (58, 60), (60, 62)))
    return len(code) >= max(64, at + size * count)
