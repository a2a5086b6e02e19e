// Sixteen integers, matching the sixteen floats of common/floats.h; conversions between the two; and integer image
// sampling. All operations are exact, so each instruction set gives the same bits. Included once for each instruction
// set, inside its own namespace PCB_ISA, see kernels_isa.h.
#pragma once
#include "common/floats.h"

namespace pcbench::mvs::PCB_ISA {

#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512BW__)

struct Ints {
    __m512i v;
    Ints() = default;
    Ints(__m512i registers) : v(registers) {}
    explicit Ints(int32_t s) : v(_mm512_set1_epi32(s)) {}
};
inline Floats permute(Floats a, Ints lanes) { return {_mm512_permutexvar_ps(lanes.v, a.v)}; }
inline Ints truncate(Floats a) { return {_mm512_cvttps_epi32(a.v)}; }
inline Floats to_floats(Ints a) { return {_mm512_cvtepi32_ps(a.v)}; }
inline Ints load(const int32_t* p) { return {_mm512_loadu_si512(p)}; }
inline void store(int32_t* p, Ints a) { _mm512_storeu_si512(p, a.v); }
inline Ints operator+(Ints a, Ints b) { return {_mm512_add_epi32(a.v, b.v)}; }
inline Ints operator-(Ints a, Ints b) { return {_mm512_sub_epi32(a.v, b.v)}; }
inline Ints operator*(Ints a, Ints b) { return {_mm512_mullo_epi32(a.v, b.v)}; }
inline Ints operator&(Ints a, Ints b) { return {_mm512_and_si512(a.v, b.v)}; }
inline Ints operator^(Ints a, Ints b) { return {_mm512_xor_si512(a.v, b.v)}; }
inline Ints lesser(Ints a, Ints b) { return {_mm512_min_epi32(a.v, b.v)}; }
inline Ints greater(Ints a, Ints b) { return {_mm512_max_epi32(a.v, b.v)}; }
template <int kBits>
inline Ints shift_right(Ints a) {
    return {_mm512_srli_epi32(a.v, kBits)};
}
inline Ints gather(const int32_t* from, Ints at) { return {_mm512_i32gather_epi32(at.v, from, 4)}; }
inline Floats gather(const float* from, Ints at) { return {_mm512_i32gather_ps(at.v, from, 4)}; }
inline Ints pixel_index(Ints x, Ints y, int32_t width) {
    const __m512i both = _mm512_mask_blend_epi16(0xaaaaaaaa, _mm512_srli_epi32(x.v, 16), y.v);
    return {_mm512_madd_epi16(both, _mm512_set1_epi32(width << 16 | 1))};
}
inline Ints interpolate(Ints quad, Ints x, Ints y) {
    const __m512i across =
        _mm512_xor_si512(_mm512_shuffle_epi8(x.v, _mm512_set4_epi32(0x0d0d0d0d, 0x09090909, 0x05050505, 0x01010101)),
                         _mm512_set1_epi32(0x00ff00ff));
    const __m512i down = _mm512_xor_si512(
        _mm512_shuffle_epi8(y.v, _mm512_set4_epi32(static_cast<int>(0x800d800d), static_cast<int>(0x80098009),
                                                   static_cast<int>(0x80058005), static_cast<int>(0x80018001))),
        _mm512_set1_epi32(0xff));
    return {_mm512_madd_epi16(_mm512_maddubs_epi16(across, quad.v), down)};
}

#elif defined(__AVX2__)

struct Ints {
    __m256i a, b;
    Ints() = default;
    Ints(__m256i low, __m256i high) : a(low), b(high) {}
    explicit Ints(int32_t s) : a(_mm256_set1_epi32(s)), b(_mm256_set1_epi32(s)) {}
};
inline __m256 permute_half(Floats x, __m256i lanes) {
    const __m256 upper = _mm256_castsi256_ps(_mm256_slli_epi32(lanes, 28));
    return _mm256_blendv_ps(_mm256_permutevar8x32_ps(x.a, lanes), _mm256_permutevar8x32_ps(x.b, lanes), upper);
}
inline Floats permute(Floats x, Ints lanes) { return {permute_half(x, lanes.a), permute_half(x, lanes.b)}; }
inline Ints truncate(Floats x) { return {_mm256_cvttps_epi32(x.a), _mm256_cvttps_epi32(x.b)}; }
inline Floats to_floats(Ints x) { return {_mm256_cvtepi32_ps(x.a), _mm256_cvtepi32_ps(x.b)}; }
inline Ints load(const int32_t* p) {
    const auto* q = reinterpret_cast<const __m256i*>(p);
    return {_mm256_loadu_si256(q), _mm256_loadu_si256(q + 1)};
}
inline void store(int32_t* p, Ints x) {
    auto* q = reinterpret_cast<__m256i*>(p);
    _mm256_storeu_si256(q, x.a), _mm256_storeu_si256(q + 1, x.b);
}
inline Ints operator+(Ints x, Ints y) { return {_mm256_add_epi32(x.a, y.a), _mm256_add_epi32(x.b, y.b)}; }
inline Ints operator-(Ints x, Ints y) { return {_mm256_sub_epi32(x.a, y.a), _mm256_sub_epi32(x.b, y.b)}; }
inline Ints operator*(Ints x, Ints y) { return {_mm256_mullo_epi32(x.a, y.a), _mm256_mullo_epi32(x.b, y.b)}; }
inline Ints operator&(Ints x, Ints y) { return {_mm256_and_si256(x.a, y.a), _mm256_and_si256(x.b, y.b)}; }
inline Ints operator^(Ints x, Ints y) { return {_mm256_xor_si256(x.a, y.a), _mm256_xor_si256(x.b, y.b)}; }
inline Ints lesser(Ints x, Ints y) { return {_mm256_min_epi32(x.a, y.a), _mm256_min_epi32(x.b, y.b)}; }
inline Ints greater(Ints x, Ints y) { return {_mm256_max_epi32(x.a, y.a), _mm256_max_epi32(x.b, y.b)}; }
template <int kBits>
inline Ints shift_right(Ints x) {
    return {_mm256_srli_epi32(x.a, kBits), _mm256_srli_epi32(x.b, kBits)};
}
inline Ints gather(const int32_t* from, Ints at) {
    return {_mm256_i32gather_epi32(from, at.a, 4), _mm256_i32gather_epi32(from, at.b, 4)};
}
inline Floats gather(const float* from, Ints at) {
    return {_mm256_i32gather_ps(from, at.a, 4), _mm256_i32gather_ps(from, at.b, 4)};
}
inline __m256i pixel_index_half(__m256i x, __m256i y, int32_t width) {
    const __m256i both = _mm256_blend_epi16(_mm256_srli_epi32(x, 16), y, 0xaa);
    return _mm256_madd_epi16(both, _mm256_set1_epi32(width << 16 | 1));
}
inline Ints pixel_index(Ints x, Ints y, int32_t width) {
    return {pixel_index_half(x.a, y.a, width), pixel_index_half(x.b, y.b, width)};
}
inline __m256i interpolate_half(__m256i quad, __m256i x, __m256i y) {
    const __m256i second = _mm256_setr_epi8(1, 1, 1, 1, 5, 5, 5, 5, 9, 9, 9, 9, 13, 13, 13, 13, 1, 1, 1, 1, 5, 5, 5, 5,
                                            9, 9, 9, 9, 13, 13, 13, 13);
    const __m256i words = _mm256_set1_epi16(0xff);
    const __m256i across = _mm256_xor_si256(_mm256_shuffle_epi8(x, second), words);
    const __m256i down =
        _mm256_xor_si256(_mm256_and_si256(_mm256_shuffle_epi8(y, second), words), _mm256_set1_epi32(0xff));
    return _mm256_madd_epi16(_mm256_maddubs_epi16(across, quad), down);
}
inline Ints interpolate(Ints quad, Ints x, Ints y) {
    return {interpolate_half(quad.a, x.a, y.a), interpolate_half(quad.b, x.b, y.b)};
}

#else

struct Ints {
    int32_t v[kLanes];
    Ints() = default;
    explicit Ints(int32_t s) {
        for (int i = 0; i < kLanes; ++i) v[i] = s;
    }
};
#define PCB_EACH(type, expression)                            \
    type out;                                                 \
    for (int i = 0; i < kLanes; ++i) out.v[i] = (expression); \
    return out
inline Floats permute(Floats a, Ints lanes) { PCB_EACH(Floats, a.v[lanes.v[i]]); }
inline Ints truncate(Floats a) { PCB_EACH(Ints, static_cast<int32_t>(a.v[i])); }
inline Floats to_floats(Ints a) { PCB_EACH(Floats, static_cast<float>(a.v[i])); }
inline Ints load(const int32_t* p) { PCB_EACH(Ints, p[i]); }
inline void store(int32_t* p, Ints a) {
    for (int i = 0; i < kLanes; ++i) p[i] = a.v[i];
}
// Integer sums and products are modulo 2^32.
inline Ints operator+(Ints a, Ints b) {
    PCB_EACH(Ints, static_cast<int32_t>(static_cast<uint32_t>(a.v[i]) + static_cast<uint32_t>(b.v[i])));
}
inline Ints operator-(Ints a, Ints b) {
    PCB_EACH(Ints, static_cast<int32_t>(static_cast<uint32_t>(a.v[i]) - static_cast<uint32_t>(b.v[i])));
}
inline Ints operator*(Ints a, Ints b) {
    PCB_EACH(Ints, static_cast<int32_t>(static_cast<uint32_t>(a.v[i]) * static_cast<uint32_t>(b.v[i])));
}
inline Ints operator&(Ints a, Ints b) { PCB_EACH(Ints, a.v[i] & b.v[i]); }
inline Ints operator^(Ints a, Ints b) { PCB_EACH(Ints, a.v[i] ^ b.v[i]); }
inline Ints lesser(Ints a, Ints b) { PCB_EACH(Ints, a.v[i] < b.v[i] ? a.v[i] : b.v[i]); }
inline Ints greater(Ints a, Ints b) { PCB_EACH(Ints, a.v[i] > b.v[i] ? a.v[i] : b.v[i]); }
template <int kBits>
inline Ints shift_right(Ints a) {
    PCB_EACH(Ints, static_cast<int32_t>(static_cast<uint32_t>(a.v[i]) >> kBits));
}
inline Ints gather(const int32_t* from, Ints at) { PCB_EACH(Ints, from[at.v[i]]); }
inline Floats gather(const float* from, Ints at) { PCB_EACH(Floats, from[at.v[i]]); }
// Index of the pixel that contains 16.16 fixed-point coordinates (not negative) in an image of the given width.
inline Ints pixel_index(Ints x, Ints y, int32_t width) { PCB_EACH(Ints, (y.v[i] >> 16) * width + (x.v[i] >> 16)); }
// Bilinear interpolation times 65025 (255 squared) at 16.16 coordinates, between the four signed bytes of a quad. The
// weights are the upper eight bits of the coordinates' fractions, over 255.
inline Ints interpolate(Ints quad, Ints x, Ints y) {
    const auto byte = [&](int i, int k) {
        return static_cast<int32_t>(static_cast<int8_t>(static_cast<uint32_t>(quad.v[i]) >> 8 * k));
    };
    const auto part = [](int32_t at) { return at >> 8 & 255; };
    const auto along = [&](int i, int k) { return (255 - part(x.v[i])) * byte(i, k) + part(x.v[i]) * byte(i, k + 1); };
    PCB_EACH(Ints, (255 - part(y.v[i])) * along(i, 0) + part(y.v[i]) * along(i, 2));
}
#undef PCB_EACH

#endif

}  // namespace pcbench::mvs::PCB_ISA
