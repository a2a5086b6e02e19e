// Precedes all kernels: the functions that maths.h needs, for F a float on a GPU. Kernels are compiled without
// contraction (fma = false), so as on the CPU only `fused` rounds once.

#define PCB_FN __device__ inline

__device__ inline float fused(float a, float b, float c) { return __fmaf_rn(a, b, c); }
__device__ inline float root(float x) { return __fsqrt_rn(x); }
// If one argument is NaN the result is the second, as with the vector instructions of the CPU.
__device__ inline float lesser(float a, float b) { return a < b ? a : b; }
__device__ inline float greater(float a, float b) { return b < a ? a : b; }
__device__ inline float select(bool mask, float yes, float no) { return mask ? yes : no; }
__device__ inline float add_exponent(float x, float n) {
    return __int_as_float(__float_as_int(x) + static_cast<int>(n) * 0x00800000);
}
__device__ inline float exponent(float x, float& mantissa) {
    const int bits = __float_as_int(x);
    mantissa = __int_as_float((bits & 0x007fffff) | 0x3f800000);
    return static_cast<float>((bits >> 23) - 127);
}

constexpr unsigned kWarp = 0xffffffffu;  // mask of all lanes of a warp
constexpr int kLanes = 32;
