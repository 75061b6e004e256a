// SPDX-License-Identifier: Apache-2.0
// Functions, loops and masks on either device. On a GPU a world is a thread's own, or the lanes of a warp share it
// (COOPERATE): then every lane runs the same code with the same numbers, but for loops over EACH, which they divide
// among themselves; SYNC stands wherever one lane reads what others wrote, or writes what they still read.
#if defined(__CUDA_ARCH__) && SHARED
#define COOPERATE 1
#define EACH(k, n) _Pragma("unroll 1") for (int k = threadIdx.x & 31; k < (n); k += 32)
#define SYNC __syncwarp();
#else
#define COOPERATE 0
#define EACH(k, n) for (int k = 0; k < (n); ++k)
#define SYNC
#endif
#if defined(__CUDA_ARCH__)
#define BY_DEVICE(gpu, cpu) gpu
#define FN static __device__ __noinline__
#define INLINE static __device__ __forceinline__
#define INNER __device__ __forceinline__
#define UNROLL _Pragma("unroll")
#define VNOT(m) (!(m))
#define VBITS(m) ((m) ? 1u : 0u)
#define YES ((I)1)
#define FMA(a, b, c) __fmaf_rn(a, b, c)
#else
#define BY_DEVICE(gpu, cpu) cpu
#define FN __attribute__((noinline)) static
#define INLINE __attribute__((always_inline)) static inline
#define INNER __attribute__((always_inline)) inline
#define UNROLL _Pragma("clang loop unroll(full)")
#define VNOT(m) (~(m))
#define VBITS(m) bits(m)
#define YES ((I)(-1))
#if defined(__FMA__) || defined(__aarch64__)
#define FMA(a, b, c) __builtin_elementwise_fma((T)(a), (T)(b), (T)(c))
#else
#define FMA(a, b, c) ((a) * (b) + (c))
#endif
#endif
#define NO ((I)0)
#define LANE(x, l) (((float*)&(x))[l])
// Number N of every world's in a row of the record: WIDTH numbers a world, TO where the first world's begin
#define PUT(TO, WIDTH, N, VALUE) \
    { const T value = VALUE; for (int l = 0; l < count; ++l) (TO)[l * (WIDTH) + (N)] = LANE(value, l); }
// Look closely at those of N pairs of one kind, the first of them FIRST, that TEST finds near. A lane of a warp goes on
// to the next such pair of its own before all of them look, so that few rounds are needed.
#if COOPERATE
#define NEAR_PAIRS(N, FIRST, LOOK, TEST)                                         \
    _Pragma("unroll 1") for (int i = threadIdx.x & 31; some(i < (N)); i += 32) { \
        int pair = FIRST, a = 0, b = 0;                                          \
        I near = NO;                                                             \
        _Pragma("unroll 1") for (; i < (N); i += 32) {                           \
            pair = FIRST + i, a = first[i], b = second[i];                       \
            TEST                                                                 \
            if (near) break;                                                     \
        }                                                                        \
        if (near) LOOK(w, pair, a, b, near);                                     \
    }
#else
#define NEAR_PAIRS(N, FIRST, LOOK, TEST)                                         \
    for (int i = 0; i < (N); ++i) {                                              \
        const int pair = FIRST + i, a = first[i], b = second[i];                 \
        I near;                                                                  \
        TEST                                                                     \
        if (VANY(near)) LOOK(w, pair, a, b, near);                               \
    }
#endif
