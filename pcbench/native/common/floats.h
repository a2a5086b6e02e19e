// A SIMD vector of sixteen floats, with a mask, on the registers that this translation unit may use. Every operation is
// one IEEE operation per lane, without reassociation. A multiply-add is used only if requested, and then has a single
// rounding everywhere. Each instruction set therefore gives the same bits. Square roots are compiler built-ins, because
// the linker would keep one copy of std::sqrt(float) for all instruction sets. Included once per instruction set, into
// its own namespace PCB_SPACE.
#pragma once
#include <cstdint>

#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace PCB_SPACE {

constexpr int kLanes = 16;

#if defined(__AVX512F__) && defined(__AVX512DQ__)

struct Floats {
    __m512 v;
    Floats() = default;
    Floats(__m512 registers) : v(registers) {}
    explicit Floats(float s) : v(_mm512_set1_ps(s)) {}
};
struct Mask {
    __mmask16 m;
};
inline Floats load(const float* p) { return _mm512_loadu_ps(p); }
inline void store(float* p, Floats a) { _mm512_storeu_ps(p, a.v); }
inline Floats load_first(const float* p, int count) {
    return _mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << count) - 1u), p);
}
inline void store_first(float* p, int count, Floats a) {
    _mm512_mask_storeu_ps(p, static_cast<__mmask16>((1u << count) - 1u), a.v);
}
inline Floats load_strided(const float* p, int stride) {
    const __m512i steps = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    return _mm512_i32gather_ps(_mm512_mullo_epi32(steps, _mm512_set1_epi32(stride)), p, 4);
}
inline Floats operator+(Floats a, Floats b) { return _mm512_add_ps(a.v, b.v); }
inline Floats operator-(Floats a) { return -a.v; }
inline Floats operator-(Floats a, Floats b) { return _mm512_sub_ps(a.v, b.v); }
inline Floats operator*(Floats a, Floats b) { return _mm512_mul_ps(a.v, b.v); }
inline Floats operator/(Floats a, Floats b) { return _mm512_div_ps(a.v, b.v); }
inline Floats fused(Floats a, Floats b, Floats c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }
inline Floats lesser(Floats a, Floats b) { return _mm512_min_ps(a.v, b.v); }
inline Floats greater(Floats a, Floats b) { return _mm512_max_ps(a.v, b.v); }
inline Floats root(Floats a) { return _mm512_sqrt_ps(a.v); }
inline Mask operator<(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
inline Mask operator<=(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)}; }
inline Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.m & b.m)}; }
inline Mask operator~(Mask a) { return {static_cast<__mmask16>(~a.m)}; }
inline unsigned bits(Mask m) { return m.m; }
inline Floats select(Mask m, Floats yes, Floats no) { return _mm512_mask_blend_ps(m.m, no.v, yes.v); }
// x * 2^power, for integer powers and normal results.
inline Floats add_exponent(Floats x, Floats power) { return _mm512_scalef_ps(x.v, power.v); }
// The exponent of positive normal x, and its mantissa in [1, 2).
inline Floats exponent(Floats x, Floats& mantissa) {
    const __m512i all = _mm512_castps_si512(x.v);
    mantissa = _mm512_castsi512_ps(
        _mm512_or_epi32(_mm512_and_epi32(all, _mm512_set1_epi32(0x007fffff)), _mm512_set1_epi32(0x3f800000)));
    return _mm512_cvtepi32_ps(_mm512_sub_epi32(_mm512_srli_epi32(all, 23), _mm512_set1_epi32(127)));
}
// Sums of the lanes of up to sixteen vectors, in as many lanes; the others are undefined. Halves are added to each
// other: lane i and i + 8, then i + 4, i + 2, i + 1.
template <int kCount>
inline Floats sums(const Floats* vectors) {
    static_assert(kCount > 8 && kCount <= kLanes, "expected more than eight vectors");
    const auto fold = [](__m512 a, __m512 b) {
        return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xee));
    };
    __m512 quarters[4];
    for (int k = 0; k < 4; ++k) {
        const __m512 low = fold(vectors[k].v, vectors[k + 4].v);
        const int third = k + 8 < kCount ? k + 8 : 8, last = k + 12 < kCount ? k + 12 : third;
        const __m512 high = fold(vectors[third].v, vectors[last].v);
        quarters[k] = _mm512_add_ps(_mm512_shuffle_f32x4(low, high, 0x88), _mm512_shuffle_f32x4(low, high, 0xdd));
    }
    const auto halve = [](__m512 a, __m512 b) {
        return _mm512_add_ps(_mm512_shuffle_ps(a, b, 0x44), _mm512_shuffle_ps(a, b, 0xee));
    };
    const __m512 even = halve(quarters[0], quarters[1]), odd = halve(quarters[2], quarters[3]);
    return _mm512_add_ps(_mm512_shuffle_ps(even, odd, 0x88), _mm512_shuffle_ps(even, odd, 0xdd));
}
// Transposes the matrix of sixteen vectors: lane i of vector k becomes lane k of vector i.
inline void transpose(Floats* vectors) {
    __m512 pairs[kLanes], fours[kLanes];
    for (int k = 0; k < kLanes; k += 4) {  // within each quarter of four lanes, 4 x 4 matrices
        for (int i = 0; i < 4; i += 2) {
            pairs[k + i] = _mm512_unpacklo_ps(vectors[k + i].v, vectors[k + i + 1].v);
            pairs[k + i + 1] = _mm512_unpackhi_ps(vectors[k + i].v, vectors[k + i + 1].v);
        }
        for (int i = 0; i < 2; ++i) {
            fours[k + 2 * i] = _mm512_shuffle_ps(pairs[k + i], pairs[k + i + 2], 0x44);
            fours[k + 2 * i + 1] = _mm512_shuffle_ps(pairs[k + i], pairs[k + i + 2], 0xee);
        }
    }
    for (int i = 0; i < 4; ++i) {  // the quarters
        const __m512 a = _mm512_shuffle_f32x4(fours[i], fours[i + 4], 0x44),
                     b = _mm512_shuffle_f32x4(fours[i], fours[i + 4], 0xee),
                     c = _mm512_shuffle_f32x4(fours[i + 8], fours[i + 12], 0x44),
                     d = _mm512_shuffle_f32x4(fours[i + 8], fours[i + 12], 0xee);
        vectors[i] = _mm512_shuffle_f32x4(a, c, 0x88), vectors[i + 4] = _mm512_shuffle_f32x4(a, c, 0xdd);
        vectors[i + 8] = _mm512_shuffle_f32x4(b, d, 0x88), vectors[i + 12] = _mm512_shuffle_f32x4(b, d, 0xdd);
    }
}

#elif defined(__AVX2__)

struct Floats {
    __m256 a, b;
    Floats() = default;
    Floats(__m256 low, __m256 high) : a(low), b(high) {}
    explicit Floats(float s) : a(_mm256_set1_ps(s)), b(_mm256_set1_ps(s)) {}
};
struct Mask {
    __m256 a, b;
};
inline Floats load(const float* p) { return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)}; }
inline void store(float* p, Floats x) { _mm256_storeu_ps(p, x.a), _mm256_storeu_ps(p + 8, x.b); }
inline __m256i first_lanes(int count) {
    return _mm256_cmpgt_epi32(_mm256_set1_epi32(count), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7));
}
inline Floats load_first(const float* p, int count) {
    return {_mm256_maskload_ps(p, first_lanes(count)), _mm256_maskload_ps(p + 8, first_lanes(count - 8))};
}
inline void store_first(float* p, int count, Floats x) {
    _mm256_maskstore_ps(p, first_lanes(count), x.a), _mm256_maskstore_ps(p + 8, first_lanes(count - 8), x.b);
}
inline Floats load_strided(const float* p, int stride) {
    const __m256i steps = _mm256_mullo_epi32(_mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7), _mm256_set1_epi32(stride));
    return {_mm256_i32gather_ps(p, steps, 4), _mm256_i32gather_ps(p + 8 * stride, steps, 4)};
}
inline Floats operator+(Floats x, Floats y) { return {_mm256_add_ps(x.a, y.a), _mm256_add_ps(x.b, y.b)}; }
inline Floats operator-(Floats x) { return {-x.a, -x.b}; }
inline Floats operator-(Floats x, Floats y) { return {_mm256_sub_ps(x.a, y.a), _mm256_sub_ps(x.b, y.b)}; }
inline Floats operator*(Floats x, Floats y) { return {_mm256_mul_ps(x.a, y.a), _mm256_mul_ps(x.b, y.b)}; }
inline Floats operator/(Floats x, Floats y) { return {_mm256_div_ps(x.a, y.a), _mm256_div_ps(x.b, y.b)}; }
inline Floats fused(Floats x, Floats y, Floats z) {
    return {_mm256_fmadd_ps(x.a, y.a, z.a), _mm256_fmadd_ps(x.b, y.b, z.b)};
}
inline Floats lesser(Floats x, Floats y) { return {_mm256_min_ps(x.a, y.a), _mm256_min_ps(x.b, y.b)}; }
inline Floats greater(Floats x, Floats y) { return {_mm256_max_ps(x.a, y.a), _mm256_max_ps(x.b, y.b)}; }
inline Floats root(Floats x) { return {_mm256_sqrt_ps(x.a), _mm256_sqrt_ps(x.b)}; }
inline Mask operator<(Floats x, Floats y) {
    return {_mm256_cmp_ps(x.a, y.a, _CMP_LT_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_LT_OQ)};
}
inline Mask operator<=(Floats x, Floats y) {
    return {_mm256_cmp_ps(x.a, y.a, _CMP_LE_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_LE_OQ)};
}
inline Mask operator&(Mask x, Mask y) { return {_mm256_and_ps(x.a, y.a), _mm256_and_ps(x.b, y.b)}; }
inline Mask operator~(Mask x) {
    const __m256 all = _mm256_castsi256_ps(_mm256_set1_epi32(-1));
    return {_mm256_xor_ps(x.a, all), _mm256_xor_ps(x.b, all)};
}
inline unsigned bits(Mask m) { return _mm256_movemask_ps(m.a) | _mm256_movemask_ps(m.b) << 8; }
inline Floats select(Mask m, Floats yes, Floats no) {
    return {_mm256_blendv_ps(no.a, yes.a, m.a), _mm256_blendv_ps(no.b, yes.b, m.b)};
}
inline __m256 add_exponent(__m256 x, __m256 power) {
    const __m256i n = _mm256_slli_epi32(_mm256_cvtps_epi32(power), 23);
    return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(x), n));
}
inline __m256 exponent(__m256 x, __m256& mantissa) {
    const __m256i all = _mm256_castps_si256(x);
    mantissa = _mm256_castsi256_ps(
        _mm256_or_si256(_mm256_and_si256(all, _mm256_set1_epi32(0x007fffff)), _mm256_set1_epi32(0x3f800000)));
    return _mm256_cvtepi32_ps(_mm256_sub_epi32(_mm256_srli_epi32(all, 23), _mm256_set1_epi32(127)));
}
inline Floats add_exponent(Floats x, Floats power) { return {add_exponent(x.a, power.a), add_exponent(x.b, power.b)}; }
inline Floats exponent(Floats x, Floats& mantissa) { return {exponent(x.a, mantissa.a), exponent(x.b, mantissa.b)}; }
template <int kCount>
inline Floats sums(const Floats* vectors) {
    const auto sum_eight = [](const Floats* group) {
        const auto fold = [](Floats x, Floats y) {
            const __m256 p = _mm256_add_ps(x.a, x.b), q = _mm256_add_ps(y.a, y.b);
            return _mm256_add_ps(_mm256_permute2f128_ps(p, q, 0x20), _mm256_permute2f128_ps(p, q, 0x31));
        };
        const auto halve = [](__m256 p, __m256 q) {
            return _mm256_add_ps(_mm256_shuffle_ps(p, q, 0x44), _mm256_shuffle_ps(p, q, 0xee));
        };
        const __m256 even = halve(fold(group[0], group[4]), fold(group[1], group[5]));
        const __m256 odd = halve(fold(group[2], group[6]), fold(group[3], group[7]));
        return _mm256_add_ps(_mm256_shuffle_ps(even, odd, 0x88), _mm256_shuffle_ps(even, odd, 0xdd));
    };
    return {sum_eight(vectors), sum_eight(vectors + 8)};
}
inline void transpose(Floats* vectors) {
    const auto transpose_eight = [](const __m256* from, __m256* to) {
        __m256 pairs[8], fours[8];
        for (int i = 0; i < 8; i += 2) {
            pairs[i] = _mm256_unpacklo_ps(from[i], from[i + 1]);
            pairs[i + 1] = _mm256_unpackhi_ps(from[i], from[i + 1]);
        }
        for (int k = 0; k < 8; k += 4)
            for (int i = 0; i < 2; ++i) {
                fours[k + 2 * i] = _mm256_shuffle_ps(pairs[k + i], pairs[k + i + 2], 0x44);
                fours[k + 2 * i + 1] = _mm256_shuffle_ps(pairs[k + i], pairs[k + i + 2], 0xee);
            }
        for (int i = 0; i < 4; ++i) {
            to[i] = _mm256_permute2f128_ps(fours[i], fours[i + 4], 0x20);
            to[i + 4] = _mm256_permute2f128_ps(fours[i], fours[i + 4], 0x31);
        }
    };
    __m256 quarters[4][8], transposed[4][8];
    for (int k = 0; k < 8; ++k) {
        quarters[0][k] = vectors[k].a, quarters[1][k] = vectors[k].b;
        quarters[2][k] = vectors[k + 8].a, quarters[3][k] = vectors[k + 8].b;
    }
    for (int k = 0; k < 4; ++k) transpose_eight(quarters[k], transposed[k]);
    for (int k = 0; k < 8; ++k) {
        vectors[k] = {transposed[0][k], transposed[2][k]};
        vectors[k + 8] = {transposed[1][k], transposed[3][k]};
    }
}

#else

struct Floats {
    float v[kLanes];
    Floats() = default;
    explicit Floats(float s) {
        for (int i = 0; i < kLanes; ++i) v[i] = s;
    }
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
inline Floats load_first(const float* p, int count) { PCB_EACH(Floats, i < count ? p[i] : 0.0f); }
inline void store_first(float* p, int count, Floats a) {
    for (int i = 0; i < count; ++i) p[i] = a.v[i];
}
inline Floats load_strided(const float* p, int stride) { PCB_EACH(Floats, p[i * stride]); }
inline Floats operator+(Floats a, Floats b) { PCB_EACH(Floats, a.v[i] + b.v[i]); }
inline Floats operator-(Floats a) { PCB_EACH(Floats, -a.v[i]); }
inline Floats operator-(Floats a, Floats b) { PCB_EACH(Floats, a.v[i] - b.v[i]); }
inline Floats operator*(Floats a, Floats b) { PCB_EACH(Floats, a.v[i] * b.v[i]); }
inline Floats operator/(Floats a, Floats b) { PCB_EACH(Floats, a.v[i] / b.v[i]); }
inline Floats fused(Floats a, Floats b, Floats c) { PCB_EACH(Floats, __builtin_fmaf(a.v[i], b.v[i], c.v[i])); }
inline Floats lesser(Floats a, Floats b) { PCB_EACH(Floats, a.v[i] < b.v[i] ? a.v[i] : b.v[i]); }
inline Floats greater(Floats a, Floats b) { PCB_EACH(Floats, a.v[i] > b.v[i] ? a.v[i] : b.v[i]); }
inline Floats root(Floats a) { PCB_EACH(Floats, __builtin_sqrtf(a.v[i])); }
inline Mask operator<(Floats a, Floats b) { PCB_EACH(Mask, -static_cast<int32_t>(a.v[i] < b.v[i])); }
inline Mask operator<=(Floats a, Floats b) { PCB_EACH(Mask, -static_cast<int32_t>(a.v[i] <= b.v[i])); }
inline Mask operator&(Mask a, Mask b) { PCB_EACH(Mask, a.v[i] & b.v[i]); }
inline Mask operator~(Mask a) { PCB_EACH(Mask, ~a.v[i]); }
inline unsigned bits(Mask m) {
    unsigned out = 0;
    for (int i = 0; i < kLanes; ++i) out |= static_cast<unsigned>(m.v[i] & 1) << i;
    return out;
}
inline Floats select(Mask m, Floats yes, Floats no) { PCB_EACH(Floats, m.v[i] ? yes.v[i] : no.v[i]); }
inline int32_t as_bits(float x) {
    int32_t out;
    __builtin_memcpy(&out, &x, sizeof out);
    return out;
}
inline float as_float(int32_t x) {
    float out;
    __builtin_memcpy(&out, &x, sizeof out);
    return out;
}
inline Floats add_exponent(Floats x, Floats power) {
    PCB_EACH(Floats, as_float(static_cast<int32_t>(static_cast<uint32_t>(as_bits(x.v[i])) +
                                                   (static_cast<uint32_t>(static_cast<int32_t>(power.v[i])) << 23))));
}
inline Floats exponent(Floats x, Floats& mantissa) {
    for (int i = 0; i < kLanes; ++i) mantissa.v[i] = as_float((as_bits(x.v[i]) & 0x007fffff) | 0x3f800000);
    PCB_EACH(Floats, static_cast<float>((as_bits(x.v[i]) >> 23) - 127));
}
template <int kCount>
inline Floats sums(const Floats* vectors) {
    Floats out = vectors[0];
    for (int k = 0; k < kCount; ++k) {
        Floats folded = vectors[k];
        for (int half = kLanes / 2; half > 0; half /= 2)
            for (int i = 0; i < half; ++i) folded.v[i] += folded.v[i + half];
        out.v[k] = folded.v[0];
    }
    return out;
}
inline void transpose(Floats* vectors) {
    for (int k = 0; k < kLanes; ++k)
        for (int i = 0; i < k; ++i) {
            const float lower = vectors[k].v[i];
            vectors[k].v[i] = vectors[i].v[k], vectors[i].v[k] = lower;
        }
}
#undef PCB_EACH

#endif

}  // namespace PCB_SPACE
