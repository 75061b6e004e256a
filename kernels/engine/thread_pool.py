# SPDX-License-Identifier: Apache-2.0
"""A pool of threads that replay graphs of launches: the work of its threads, in native code without Python's lock."""

import warp as wp

wp.set_module_options({"enable_backward": False})

_TAKE = """
    typedef bool (*Replay)(void*);
    typedef signed (*Acquire)(void*, signed);  // Warp makes a macro of what looks like a cast to int
    typedef void (*Release)(void*);
    unsigned long long* b = (unsigned long long*)board;
    Acquire acquire = (Acquire)b[ACQUIRE];
    Release release = (Release)b[RELEASE];
    Replay replay = (Replay)b[REPLAY];
    void** go = (void**)b[GO];
    if (id == 0) {
        __atomic_store_n(&b[FINISHED], 0ull, __ATOMIC_SEQ_CST);
        __atomic_store_n(&b[NEXT], 0ull, __ATOMIC_SEQ_CST);  // from here on helpers take parts
        unsigned long long woken = b[WOKEN];
        for (unsigned long long i = 1; i <= woken; ++i) release(go[i]);
    } else {
        __atomic_fetch_add(&b[READY], 1ull, __ATOMIC_SEQ_CST);
    }
    for (;;) {
        if (id != 0) {
            acquire(go[id], 1);
            if (__atomic_load_n(&b[QUIT], __ATOMIC_SEQ_CST)) return;
        }
        for (;;) {
            unsigned long long part = __atomic_fetch_add(&b[NEXT], 1ull, __ATOMIC_SEQ_CST);
            if (part >= b[PARTS]) break;
            ((int*)b[THREAD])[part] = id;
            if (!replay(((void**)b[GRAPHS])[part])) __atomic_store_n(&b[FAILED], 1ull, __ATOMIC_SEQ_CST);
            if (__atomic_add_fetch(&b[FINISHED], 1ull, __ATOMIC_SEQ_CST) == b[PARTS]) release((void*)b[DONE]);
        }
        if (id == 0) {
            acquire((void*)b[DONE], 1);
            return;
        }
    }
"""

BOARD = (
    ("ACQUIRE", "RELEASE", "REPLAY")  # addresses of functions: take a lock, let go of it, replay a graph
    + ("GO", "DONE")  # addresses: of the addresses of the locks that threads wait at, of the lock the caller waits at
    + ("GRAPHS", "THREAD", "PARTS")  # addresses of the parts' graphs, of what tells who took each; their number
    + ("NEXT", "FINISHED", "FAILED", "QUIT", "READY", "WOKEN")  # the next part; counts; flags
)
"""Meaning of each number of the board that a pool shares, as unsigned 64 bits."""

_SOURCE = _TAKE
for _place, _name in enumerate(BOARD):
    _SOURCE = _SOURCE.replace(f"b[{_name}]", f"b[{_place}]")


@wp.func_native(_SOURCE)
def take_parts(board: wp.uint64, id: int):
    """Replay parts until none is left: the caller (id 0) once, helpers again and again until they are told to quit."""
    ...


@wp.kernel
def take_parts_kernel(
    # inputs
    board: wp.uint64,  # address
    id: int,
):
    """One thread: one member of the pool at work; for the CPU alone."""
    take_parts(board, id)
