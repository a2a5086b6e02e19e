// The CUDA functions and keywords that kernels use, and calling a kernel by name.
#pragma once

#include <type_traits>
#include <utility>

#include "machine.h"

namespace emulator {

// ---- calls by name

// One letter per parameter: f, i, l, s for a pointer to float, int, long long and short (or to a struct that starts
// with one), F, I, L for a float, an int and a long long.
template <class T>
constexpr char letter() {
    if (std::is_pointer_v<T>) {
        using Plain = std::remove_cv_t<std::remove_pointer_t<T>>;
        if (std::is_same_v<Plain, int>) return 'i';
        if (std::is_same_v<Plain, long long>) return 'l';
        if (std::is_same_v<Plain, float>) return 'f';
        return alignof(Plain) == 2 ? 's' : 'f';
    }
    return std::is_same_v<T, int> ? 'I' : std::is_same_v<T, long long> ? 'L' : std::is_same_v<T, float> ? 'F' : '?';
}

static void** kernel_arguments;

template <auto kKernel>
struct Call;
template <class... A, void (*kKernel)(A...)>
struct Call<kKernel> {
    static void run() { with(std::index_sequence_for<A...>{}); }
    template <size_t... I>
    static void with(std::index_sequence<I...>) {
        kKernel(*static_cast<std::remove_reference_t<A>*>(kernel_arguments[I])...);
    }
    static const char* signature() {
        static const char letters[] = {letter<A>()..., '\0'};
        return letters;
    }
};

// ---- values exchanged between the lanes of a warp

template <class T>
uint64_t packed(T value) {
    static_assert(sizeof(T) <= 8);
    uint64_t bits = 0;
    std::memcpy(&bits, &value, sizeof value);
    return bits;
}
template <class T>
T unpacked(uint64_t bits) {
    T value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}
template <class T>
T shuffled(unsigned mask, T value, unsigned source, int line) {
    return unpacked<T>(warp_operation(WarpOperation::kShuffle, mask, packed(value), source, line));
}
inline unsigned lane() { return machine.running % kWarpSize; }

}  // namespace emulator

#define EMULATED_KERNEL(name)                                                                                  \
    extern "C" const char* emulated_signature() { return emulator::Call<&name>::signature(); }                 \
    extern "C" int emulated_run(void** arguments, unsigned blocks, unsigned threads, int order, uint64_t seed, \
                                char* message, size_t room) {                                                  \
        emulator::kernel_arguments = arguments;                                                                \
        return emulator::run(emulator::Call<&name>::run, blocks, threads, order, seed, message, room);         \
    }

// ---- CUDA keywords and functions

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __launch_bounds__(...)
#if defined(__SANITIZE_ADDRESS__)
#define __shared__ static
#else
#define __shared__ static __attribute__((section("emulated_shared")))
#endif

inline void __syncthreads(int line = __builtin_LINE()) { emulator::block_barrier(0, line); }
inline int __syncthreads_count(int yes, int line = __builtin_LINE()) {
    return static_cast<int>(emulator::block_barrier(yes != 0, line));
}
inline int __syncthreads_or(int yes, int line = __builtin_LINE()) {
    return emulator::block_barrier(yes != 0, line) != 0;
}
inline int __syncthreads_and(int yes, int line = __builtin_LINE()) {
    return emulator::block_barrier(yes != 0, line) == blockDim.x;
}
inline void __syncwarp(unsigned mask = 0xffffffffu, int line = __builtin_LINE()) {
    emulator::warp_operation(emulator::WarpOperation::kSync, mask, 0, 0, line);
}
template <class T>
T __shfl_sync(unsigned mask, T value, int source, int line = __builtin_LINE()) {
    return emulator::shuffled(mask, value, static_cast<unsigned>(source) % emulator::kWarpSize, line);
}
template <class T>
T __shfl_up_sync(unsigned mask, T value, unsigned delta, int line = __builtin_LINE()) {
    const unsigned lane = emulator::lane();
    return emulator::shuffled(mask, value, lane < delta ? lane : lane - delta, line);
}
template <class T>
T __shfl_down_sync(unsigned mask, T value, unsigned delta, int line = __builtin_LINE()) {
    const unsigned lane = emulator::lane();
    return emulator::shuffled(mask, value, lane + delta < emulator::kWarpSize ? lane + delta : lane, line);
}
template <class T>
T __shfl_xor_sync(unsigned mask, T value, int lane_mask, int line = __builtin_LINE()) {
    return emulator::shuffled(mask, value, emulator::lane() ^ static_cast<unsigned>(lane_mask), line);
}
inline unsigned __ballot_sync(unsigned mask, int yes, int line = __builtin_LINE()) {
    return static_cast<unsigned>(emulator::warp_operation(emulator::WarpOperation::kBallot, mask, yes != 0, 0, line));
}
inline int __any_sync(unsigned mask, int yes, int line = __builtin_LINE()) {
    return __ballot_sync(mask, yes, line) != 0;
}
inline int __all_sync(unsigned mask, int yes, int line = __builtin_LINE()) {
    return __ballot_sync(mask, yes, line) == mask;
}
inline unsigned __reduce_add_sync(unsigned mask, unsigned value, int line = __builtin_LINE()) {
    return static_cast<unsigned>(emulator::warp_operation(emulator::WarpOperation::kAdd, mask, value, 0, line));
}
template <class T>
unsigned __match_any_sync(unsigned mask, T value, int line = __builtin_LINE()) {
    return static_cast<unsigned>(
        emulator::warp_operation(emulator::WarpOperation::kMatch, mask, emulator::packed(value), 0, line));
}
// Only one thread runs at a time.
template <class T>
T atomicAdd(T* to, T value) {
    const T before = *to;
    *to = before + value;
    return before;
}

inline float __fmaf_rn(float a, float b, float c) { return __builtin_fmaf(a, b, c); }
inline float __fsqrt_rn(float x) { return __builtin_sqrtf(x); }
inline float ceilf(float x) { return __builtin_ceilf(x); }
inline float floorf(float x) { return __builtin_floorf(x); }
inline float fabsf(float x) { return __builtin_fabsf(x); }
inline int __float_as_int(float x) { return emulator::unpacked<int>(emulator::packed(x)); }
inline float __int_as_float(int x) { return emulator::unpacked<float>(emulator::packed(x)); }
inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline int __ffs(int x) { return __builtin_ffs(x); }
inline int min(int a, int b) { return a < b ? a : b; }
inline int max(int a, int b) { return a < b ? b : a; }
