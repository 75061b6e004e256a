# SPDX-License-Identifier: Apache-2.0
"""Runs what a warp of a GPU runs, on the CPU: 32 lanes take turns from one synchronization to the next."""

import ctypes
import hashlib
import shutil
import subprocess
from pathlib import Path

import numpy as np
import warp as wp
from shared.plain_rollout import PlainRollout

from warpmpc.physics.source_parts import RolloutWork

COMPILER = shutil.which("g++")
_TYPES = {wp.float32: "float", wp.float64: "double", wp.int32: "int", float: "float", int: "int"}
_LANES = """
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ucontext.h>
#define __CUDA_ARCH__ 900
#define __device__
#define __noinline__ __attribute__((noinline))
#define __forceinline__ inline
#define __shared__ static
namespace {
ucontext_t home, lane[32];
bool ended[32];
struct { int x; } threadIdx;
void __syncwarp() { swapcontext(&lane[threadIdx.x], &home); }
float slots[32];
float __shfl_xor_sync(unsigned, float x, int m) {
    slots[threadIdx.x] = x;
    __syncwarp();
    const float r = slots[threadIdx.x ^ m];
    __syncwarp();
    return r;
}
float __shfl_sync(unsigned, float x, int from) {
    slots[threadIdx.x] = x;
    __syncwarp();
    const float r = slots[from];
    __syncwarp();
    return r;
}
bool __any_sync(unsigned, bool m) {
    slots[threadIdx.x] = m;
    __syncwarp();
    bool r = false;
    for (int l = 0; l < 32; ++l) r |= slots[l] != 0.0f;
    __syncwarp();
    return r;
}
int atomicAdd(int* p, int x) { const int was = *p; *p += x; return was; }
int atomicOr(int* p, int x) { const int was = *p; *p |= x; return was; }
template <class E> struct Array { E* data; int shape[4]; };
struct Number { int value, none; operator int() const { return value; } };
"""
_MAIN = """
void rollout(RolloutWork k, int group) {
BODY
}
RolloutWork* work;
int group;
void begin() { rollout(*work, group); ended[threadIdx.x] = true; }
}
// All lanes of one world after the other, in an order that turns with `order`; nonzero if they do not end together
extern "C" int run(RolloutWork* k, int worlds, int order) {
    static char* stacks = (char*)malloc(32u << 20);
    work = k;
    for (int world = 0; world < worlds; ++world) {
        group = order & 1 ? worlds - 1 - world : world;
        for (int l = 0; l < 32; ++l) {
            ended[l] = false;
            getcontext(&lane[l]);
            lane[l].uc_stack.ss_sp = stacks + (l << 20);
            lane[l].uc_stack.ss_size = 1 << 20;
            lane[l].uc_link = &home;
            makecontext(&lane[l], begin, 0);
        }
        for (int ends = 0; !ends;) {
            for (int i = 0; i < 32; ++i) {
                const int l = order & 2 ? 31 - i : (i + 7 * (order >> 2)) & 31;
                threadIdx.x = l;
                swapcontext(&home, &lane[l]);
                ends += ended[l];
            }
            if (ends && ends < 32) return 1;
        }
    }
    return 0;
}
"""


class Lanes:
    """A rollout by the lanes of a warp.

    Args:
        source: Its source, for a warp to a world.
        folder: Where it is compiled.
    """

    def __init__(self, source: str, folder: Path):
        fields = []
        for name, var in RolloutWork.vars.items():
            kind = f"Array<{_c_type(var.type.dtype)}>" if hasattr(var.type, "dtype") else "Number"
            fields.append(f"{kind} {name};")
        text = "\n".join((_LANES, "struct RolloutWork {", *fields, "};", _MAIN.replace("BODY", source)))
        stem = folder / hashlib.sha256(text.encode()).hexdigest()[:16]
        library = stem.with_suffix(".so")
        if not library.exists():
            stem.with_suffix(".cpp").write_text(text)
            flags = ["-O0", "-std=c++17", "-w", "-shared", "-fPIC", "-fno-strict-aliasing"]
            subprocess.run([COMPILER, *flags, "-o", library, stem.with_suffix(".cpp")], check=True)
        self._run = ctypes.CDLL(str(library)).run

    def __call__(self, work: RolloutWork, worlds: int, order: int = 0) -> None:
        """Roll worlds out; ``order`` says which lane comes first between two synchronizations, and which world."""
        numbers = []
        for name in RolloutWork.vars:
            array = getattr(work, name)
            if isinstance(array, int):
                numbers.append(np.array([array, 0], dtype=np.int32).tobytes())
                continue
            shape = (*array.shape, 0, 0, 0, 0)[:4] if array is not None else (0, 0, 0, 0)
            start = array.ptr or 0 if array is not None else 0
            numbers += [np.array([start], dtype=np.uint64).tobytes(), np.array(shape, dtype=np.int32).tobytes()]
        block = ctypes.create_string_buffer(b"".join(numbers))
        if self._run(block, worlds, order):
            raise RuntimeError("the lanes of a warp did not end together")


class LaneRollout(PlainRollout):
    """A :class:`PlainRollout` by the lanes of a warp.

    Args:
        folder: Where its source is compiled.
        **kwargs: As for :class:`PlainRollout`.
    """

    order = 0
    """Which lane comes first, and which world; results must not depend on it."""

    def __init__(self, *args, folder: Path, **kwargs):
        super().__init__(*args, **kwargs)
        self._run = Lanes(self.source(lanes=4, shared=True), folder)

    def launch(self) -> None:
        """Roll out what was given last."""
        self._run(self.work, self.worlds, self.order)


def _c_type(dtype: type) -> str:
    """Warp's vectors and transforms are rows of floats."""
    return _TYPES.get(dtype, "float")
