// A SIMD vector of eight doubles and a mask of eight booleans, on the registers that this translation unit may use.
// Every operation is one IEEE operation per lane (no fused multiply-add, no reassociation), so each instruction set
// gives the same bits. Included once per instruction set, in its own namespace PCB_ISA: see kernels_isa.h.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>

#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace pcbench::PCB_ISA {

constexpr int kLanes = 8;

#if defined(__AVX512F__) && defined(__AVX512DQ__)

struct Vector {
    __m512d v;
};
struct Mask {
    __mmask8 m;
};
inline Vector load(const double* p) { return {_mm512_loadu_pd(p)}; }
inline void store(double* p, Vector a) { _mm512_storeu_pd(p, a.v); }
inline Vector splat(double s) { return {_mm512_set1_pd(s)}; }
inline Vector operator+(Vector a, Vector b) { return {_mm512_add_pd(a.v, b.v)}; }
inline Vector operator-(Vector a, Vector b) { return {_mm512_sub_pd(a.v, b.v)}; }
inline Vector operator*(Vector a, Vector b) { return {_mm512_mul_pd(a.v, b.v)}; }
inline Vector operator/(Vector a, Vector b) { return {_mm512_div_pd(a.v, b.v)}; }
inline Vector min(Vector a, Vector b) { return {_mm512_min_pd(a.v, b.v)}; }
inline Vector max(Vector a, Vector b) { return {_mm512_max_pd(a.v, b.v)}; }
inline Vector sqrt(Vector a) { return {_mm512_sqrt_pd(a.v)}; }
inline Vector abs(Vector a) { return {_mm512_abs_pd(a.v)}; }
inline Mask operator<(Vector a, Vector b) { return {_mm512_cmp_pd_mask(a.v, b.v, _CMP_LT_OQ)}; }
inline Mask operator<=(Vector a, Vector b) { return {_mm512_cmp_pd_mask(a.v, b.v, _CMP_LE_OQ)}; }
inline Mask operator==(Vector a, Vector b) { return {_mm512_cmp_pd_mask(a.v, b.v, _CMP_EQ_OQ)}; }
inline Mask operator|(Mask a, Mask b) { return {static_cast<__mmask8>(a.m | b.m)}; }
inline Mask operator&(Mask a, Mask b) { return {static_cast<__mmask8>(a.m & b.m)}; }
inline Vector select(Mask m, Vector yes, Vector no) { return {_mm512_mask_blend_pd(m.m, no.v, yes.v)}; }
inline Mask mask_from_bits(unsigned bits) { return {static_cast<__mmask8>(bits)}; }
inline unsigned bits(Mask m) { return m.m; }

#elif defined(__AVX2__)

struct Vector {
    __m256d a, b;
};
struct Mask {
    __m256d a, b;
};
inline Vector load(const double* p) { return {_mm256_loadu_pd(p), _mm256_loadu_pd(p + 4)}; }
inline void store(double* p, Vector x) { _mm256_storeu_pd(p, x.a), _mm256_storeu_pd(p + 4, x.b); }
inline Vector splat(double s) { return {_mm256_set1_pd(s), _mm256_set1_pd(s)}; }
inline Vector operator+(Vector x, Vector y) { return {_mm256_add_pd(x.a, y.a), _mm256_add_pd(x.b, y.b)}; }
inline Vector operator-(Vector x, Vector y) { return {_mm256_sub_pd(x.a, y.a), _mm256_sub_pd(x.b, y.b)}; }
inline Vector operator*(Vector x, Vector y) { return {_mm256_mul_pd(x.a, y.a), _mm256_mul_pd(x.b, y.b)}; }
inline Vector operator/(Vector x, Vector y) { return {_mm256_div_pd(x.a, y.a), _mm256_div_pd(x.b, y.b)}; }
inline Vector min(Vector x, Vector y) { return {_mm256_min_pd(x.a, y.a), _mm256_min_pd(x.b, y.b)}; }
inline Vector max(Vector x, Vector y) { return {_mm256_max_pd(x.a, y.a), _mm256_max_pd(x.b, y.b)}; }
inline Vector sqrt(Vector x) { return {_mm256_sqrt_pd(x.a), _mm256_sqrt_pd(x.b)}; }
inline Vector abs(Vector x) {
    const __m256d sign = _mm256_set1_pd(-0.0);
    return {_mm256_andnot_pd(sign, x.a), _mm256_andnot_pd(sign, x.b)};
}
inline Mask operator<(Vector x, Vector y) {
    return {_mm256_cmp_pd(x.a, y.a, _CMP_LT_OQ), _mm256_cmp_pd(x.b, y.b, _CMP_LT_OQ)};
}
inline Mask operator<=(Vector x, Vector y) {
    return {_mm256_cmp_pd(x.a, y.a, _CMP_LE_OQ), _mm256_cmp_pd(x.b, y.b, _CMP_LE_OQ)};
}
inline Mask operator==(Vector x, Vector y) {
    return {_mm256_cmp_pd(x.a, y.a, _CMP_EQ_OQ), _mm256_cmp_pd(x.b, y.b, _CMP_EQ_OQ)};
}
inline Mask operator&(Mask x, Mask y) { return {_mm256_and_pd(x.a, y.a), _mm256_and_pd(x.b, y.b)}; }
inline Mask operator|(Mask x, Mask y) { return {_mm256_or_pd(x.a, y.a), _mm256_or_pd(x.b, y.b)}; }
inline Vector select(Mask m, Vector yes, Vector no) {
    return {_mm256_blendv_pd(no.a, yes.a, m.a), _mm256_blendv_pd(no.b, yes.b, m.b)};
}
inline Mask mask_from_bits(unsigned bits) {
    const __m256i all = _mm256_set1_epi64x(bits);
    const __m256i low = _mm256_set_epi64x(8, 4, 2, 1), high = _mm256_set_epi64x(128, 64, 32, 16);
    return {_mm256_castsi256_pd(_mm256_cmpeq_epi64(_mm256_and_si256(all, low), low)),
            _mm256_castsi256_pd(_mm256_cmpeq_epi64(_mm256_and_si256(all, high), high))};
}
inline unsigned bits(Mask m) { return _mm256_movemask_pd(m.a) | _mm256_movemask_pd(m.b) << 4; }

#else

struct Vector {
    double v[kLanes];
};
struct Mask {
    int64_t v[kLanes];  // 0 or -1
};
#define PCB_EACH(type, expression)                            \
    type out;                                                 \
    for (int i = 0; i < kLanes; ++i) out.v[i] = (expression); \
    return out
inline Vector load(const double* p) { PCB_EACH(Vector, p[i]); }
inline void store(double* p, Vector a) {
    for (int i = 0; i < kLanes; ++i) p[i] = a.v[i];
}
inline Vector splat(double s) { PCB_EACH(Vector, s); }
inline Vector operator+(Vector a, Vector b) { PCB_EACH(Vector, a.v[i] + b.v[i]); }
inline Vector operator-(Vector a, Vector b) { PCB_EACH(Vector, a.v[i] - b.v[i]); }
inline Vector operator*(Vector a, Vector b) { PCB_EACH(Vector, a.v[i] * b.v[i]); }
inline Vector operator/(Vector a, Vector b) { PCB_EACH(Vector, a.v[i] / b.v[i]); }
inline Vector min(Vector a, Vector b) { PCB_EACH(Vector, a.v[i] < b.v[i] ? a.v[i] : b.v[i]); }
inline Vector max(Vector a, Vector b) { PCB_EACH(Vector, a.v[i] > b.v[i] ? a.v[i] : b.v[i]); }
inline Vector sqrt(Vector a) { PCB_EACH(Vector, std::sqrt(a.v[i])); }
inline Vector abs(Vector a) { PCB_EACH(Vector, std::fabs(a.v[i])); }
inline Mask operator<(Vector a, Vector b) { PCB_EACH(Mask, -static_cast<int64_t>(a.v[i] < b.v[i])); }
inline Mask operator<=(Vector a, Vector b) { PCB_EACH(Mask, -static_cast<int64_t>(a.v[i] <= b.v[i])); }
inline Mask operator==(Vector a, Vector b) { PCB_EACH(Mask, -static_cast<int64_t>(a.v[i] == b.v[i])); }
inline Mask operator|(Mask a, Mask b) { PCB_EACH(Mask, a.v[i] | b.v[i]); }
inline Mask operator&(Mask a, Mask b) { PCB_EACH(Mask, a.v[i] & b.v[i]); }
inline Vector select(Mask m, Vector yes, Vector no) { PCB_EACH(Vector, m.v[i] ? yes.v[i] : no.v[i]); }
inline Mask mask_from_bits(unsigned bits) { PCB_EACH(Mask, -static_cast<int64_t>(bits >> i & 1)); }
inline unsigned bits(Mask m) {
    unsigned out = 0;
    for (int i = 0; i < kLanes; ++i) out |= static_cast<unsigned>(m.v[i] & 1) << i;
    return out;
}
#undef PCB_EACH

#endif

// Replaces std::min, of which the linker would keep one copy for all instruction sets.
inline size_t min_size(size_t a, size_t b) { return b < a ? b : a; }

// Swaps two groups of four doubles, 32-byte aligned and possibly identical.
inline void swap_four(double* a, double* b) {
#if defined(__AVX2__)
    const __m256d keep = _mm256_load_pd(a);
    _mm256_store_pd(a, _mm256_load_pd(b));
    _mm256_store_pd(b, keep);
#else
    for (int i = 0; i < 4; ++i) {
        const double keep = a[i];
        a[i] = b[i];
        b[i] = keep;
    }
#endif
}

// Squared length of (x, y, z). This order of operations defines the exact result in this module.
inline Vector squared_length(Vector x, Vector y, Vector z) { return (x * x + y * y) + z * z; }

inline double max_lane(Vector a) {
    double v[kLanes];
    store(v, a);
    const double p = v[0] > v[1] ? v[0] : v[1], q = v[2] > v[3] ? v[2] : v[3];
    const double r = v[4] > v[5] ? v[4] : v[5], s = v[6] > v[7] ? v[6] : v[7];
    const double t = p > q ? p : q, u = r > s ? r : s;
    return t > u ? t : u;
}

}  // namespace pcbench::PCB_ISA
