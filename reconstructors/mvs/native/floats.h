// A SIMD vector of sixteen floats, on whatever registers this translation unit may use, with integers and a mask alike.
// Every operation is one IEEE operation on each lane (no fused multiply-add, no reassociation), so each instruction set
// gives the same bits. Roots and moduli are the compiler's own: of std::sqrt(float) the linker would keep one copy for
// all instruction sets. Included once for each instruction set, inside its own namespace PCB_ISA: see kernels_isa.h.
#pragma once
#include <cstdint>

#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace pcbench::mvs::PCB_ISA {

constexpr int kLanes = 16;

#if defined(__AVX512F__) && defined(__AVX512DQ__)

struct Floats {
    __m512 v;
};
struct Ints {
    __m512i v;
};
struct Mask {
    __mmask16 m;
};
inline Floats load(const float* p) { return {_mm512_loadu_ps(p)}; }
inline void store(float* p, Floats a) { _mm512_storeu_ps(p, a.v); }
inline Floats splat(float s) { return {_mm512_set1_ps(s)}; }
inline Floats operator+(Floats a, Floats b) { return {_mm512_add_ps(a.v, b.v)}; }
inline Floats operator-(Floats a, Floats b) { return {_mm512_sub_ps(a.v, b.v)}; }
inline Floats operator*(Floats a, Floats b) { return {_mm512_mul_ps(a.v, b.v)}; }
inline Floats operator/(Floats a, Floats b) { return {_mm512_div_ps(a.v, b.v)}; }
inline Floats min(Floats a, Floats b) { return {_mm512_min_ps(a.v, b.v)}; }
inline Floats max(Floats a, Floats b) { return {_mm512_max_ps(a.v, b.v)}; }
inline Floats sqrt(Floats a) { return {_mm512_sqrt_ps(a.v)}; }
inline Mask operator<(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
inline Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.m & b.m)}; }
inline Floats select(Mask m, Floats yes, Floats no) { return {_mm512_mask_blend_ps(m.m, no.v, yes.v)}; }
inline Ints truncated(Floats a) { return {_mm512_cvttps_epi32(a.v)}; }
inline Floats floats(Ints a) { return {_mm512_cvtepi32_ps(a.v)}; }
inline Ints splat(int32_t s) { return {_mm512_set1_epi32(s)}; }
inline Ints operator+(Ints a, Ints b) { return {_mm512_add_epi32(a.v, b.v)}; }
inline Ints operator*(Ints a, Ints b) { return {_mm512_mullo_epi32(a.v, b.v)}; }
inline Ints operator&(Ints a, Ints b) { return {_mm512_and_si512(a.v, b.v)}; }
template <int kBits>
inline Ints shifted_right(Ints a) {
    return {_mm512_srli_epi32(a.v, kBits)};
}
inline Ints gather(const uint32_t* from, Ints at) { return {_mm512_i32gather_epi32(at.v, from, 4)}; }
inline Floats gather(const float* from, Ints at) { return {_mm512_i32gather_ps(at.v, from, 4)}; }

#elif defined(__AVX2__)

struct Floats {
    __m256 a, b;
};
struct Ints {
    __m256i a, b;
};
struct Mask {
    __m256 a, b;
};
inline Floats load(const float* p) { return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)}; }
inline void store(float* p, Floats x) { _mm256_storeu_ps(p, x.a), _mm256_storeu_ps(p + 8, x.b); }
inline Floats splat(float s) { return {_mm256_set1_ps(s), _mm256_set1_ps(s)}; }
inline Floats operator+(Floats x, Floats y) { return {_mm256_add_ps(x.a, y.a), _mm256_add_ps(x.b, y.b)}; }
inline Floats operator-(Floats x, Floats y) { return {_mm256_sub_ps(x.a, y.a), _mm256_sub_ps(x.b, y.b)}; }
inline Floats operator*(Floats x, Floats y) { return {_mm256_mul_ps(x.a, y.a), _mm256_mul_ps(x.b, y.b)}; }
inline Floats operator/(Floats x, Floats y) { return {_mm256_div_ps(x.a, y.a), _mm256_div_ps(x.b, y.b)}; }
inline Floats min(Floats x, Floats y) { return {_mm256_min_ps(x.a, y.a), _mm256_min_ps(x.b, y.b)}; }
inline Floats max(Floats x, Floats y) { return {_mm256_max_ps(x.a, y.a), _mm256_max_ps(x.b, y.b)}; }
inline Floats sqrt(Floats x) { return {_mm256_sqrt_ps(x.a), _mm256_sqrt_ps(x.b)}; }
inline Mask operator<(Floats x, Floats y) {
    return {_mm256_cmp_ps(x.a, y.a, _CMP_LT_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_LT_OQ)};
}
inline Mask operator&(Mask x, Mask y) { return {_mm256_and_ps(x.a, y.a), _mm256_and_ps(x.b, y.b)}; }
inline Floats select(Mask m, Floats yes, Floats no) {
    return {_mm256_blendv_ps(no.a, yes.a, m.a), _mm256_blendv_ps(no.b, yes.b, m.b)};
}
inline Ints truncated(Floats x) { return {_mm256_cvttps_epi32(x.a), _mm256_cvttps_epi32(x.b)}; }
inline Floats floats(Ints x) { return {_mm256_cvtepi32_ps(x.a), _mm256_cvtepi32_ps(x.b)}; }
inline Ints splat(int32_t s) { return {_mm256_set1_epi32(s), _mm256_set1_epi32(s)}; }
inline Ints operator+(Ints x, Ints y) { return {_mm256_add_epi32(x.a, y.a), _mm256_add_epi32(x.b, y.b)}; }
inline Ints operator*(Ints x, Ints y) { return {_mm256_mullo_epi32(x.a, y.a), _mm256_mullo_epi32(x.b, y.b)}; }
inline Ints operator&(Ints x, Ints y) { return {_mm256_and_si256(x.a, y.a), _mm256_and_si256(x.b, y.b)}; }
template <int kBits>
inline Ints shifted_right(Ints x) {
    return {_mm256_srli_epi32(x.a, kBits), _mm256_srli_epi32(x.b, kBits)};
}
inline Ints gather(const uint32_t* from, Ints at) {
    const int* p = reinterpret_cast<const int*>(from);
    return {_mm256_i32gather_epi32(p, at.a, 4), _mm256_i32gather_epi32(p, at.b, 4)};
}
inline Floats gather(const float* from, Ints at) {
    return {_mm256_i32gather_ps(from, at.a, 4), _mm256_i32gather_ps(from, at.b, 4)};
}

#else

struct Floats {
    float v[kLanes];
};
struct Ints {
    int32_t v[kLanes];
};
struct Mask {
    int32_t v[kLanes];  // 0 or -1
};
#define PCB_EACH(type, expression)                            \
    type out;                                                 \
    for (int i = 0; i < kLanes; ++i) out.v[i] = (expression); \
    return out
inline Floats load(const float* p) { PCB_EACH(Floats, p[i]); }
inline void store(float* p, Floats a) {
    for (int i = 0; i < kLanes; ++i) p[i] = a.v[i];
}
inline Floats splat(float s) { PCB_EACH(Floats, s); }
inline Floats operator+(Floats a, Floats b) { PCB_EACH(Floats, a.v[i] + b.v[i]); }
inline Floats operator-(Floats a, Floats b) { PCB_EACH(Floats, a.v[i] - b.v[i]); }
inline Floats operator*(Floats a, Floats b) { PCB_EACH(Floats, a.v[i] * b.v[i]); }
inline Floats operator/(Floats a, Floats b) { PCB_EACH(Floats, a.v[i] / b.v[i]); }
inline Floats min(Floats a, Floats b) { PCB_EACH(Floats, a.v[i] < b.v[i] ? a.v[i] : b.v[i]); }
inline Floats max(Floats a, Floats b) { PCB_EACH(Floats, a.v[i] > b.v[i] ? a.v[i] : b.v[i]); }
inline Floats sqrt(Floats a) { PCB_EACH(Floats, __builtin_sqrtf(a.v[i])); }
inline Mask operator<(Floats a, Floats b) { PCB_EACH(Mask, -static_cast<int32_t>(a.v[i] < b.v[i])); }
inline Mask operator&(Mask a, Mask b) { PCB_EACH(Mask, a.v[i] & b.v[i]); }
inline Floats select(Mask m, Floats yes, Floats no) { PCB_EACH(Floats, m.v[i] ? yes.v[i] : no.v[i]); }
inline Ints truncated(Floats a) { PCB_EACH(Ints, static_cast<int32_t>(a.v[i])); }
inline Floats floats(Ints a) { PCB_EACH(Floats, static_cast<float>(a.v[i])); }
inline Ints splat(int32_t s) { PCB_EACH(Ints, s); }
inline Ints operator+(Ints a, Ints b) { PCB_EACH(Ints, a.v[i] + b.v[i]); }
inline Ints operator*(Ints a, Ints b) { PCB_EACH(Ints, a.v[i] * b.v[i]); }
inline Ints operator&(Ints a, Ints b) { PCB_EACH(Ints, a.v[i] & b.v[i]); }
template <int kBits>
inline Ints shifted_right(Ints a) {
    PCB_EACH(Ints, static_cast<int32_t>(static_cast<uint32_t>(a.v[i]) >> kBits));
}
inline Ints gather(const uint32_t* from, Ints at) { PCB_EACH(Ints, static_cast<int32_t>(from[at.v[i]])); }
inline Floats gather(const float* from, Ints at) { PCB_EACH(Floats, from[at.v[i]]); }
#undef PCB_EACH

#endif

}  // namespace pcbench::mvs::PCB_ISA
