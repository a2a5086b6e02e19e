// Exact sums of doubles as fixed-point numbers. They do not depend on the order of the additions.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

namespace pcbench {

// A sum is the total of limbs[k] * 2^(32 k - 128). The limbs are its digits in two's complement. Values have magnitudes
// below 2^96.
constexpr int kLimbs = 8;
constexpr int kFractionBits = 128;
constexpr int kMaxExponent = 95;
constexpr size_t kMaxAdditions = size_t{1} << 30;  // their sum stays below 2^126

// Adds a value to a sum. Bits below 2^-128 are dropped. Returns false if the value is too large or not finite; the sum
// is then unchanged.
inline bool add_exactly(double value, uint32_t* limbs) {
    constexpr uint64_t kLow = 0xffffffffu;
    uint64_t bits;
    std::memcpy(&bits, &value, sizeof bits);
    const int exponent = static_cast<int>(bits >> 52 & 0x7ff);  // a subnormal value is far below 2^-128
    if (exponent > 1023 + kMaxExponent) return false;
    uint64_t mantissa = (bits & ((uint64_t{1} << 52) - 1)) | uint64_t{1} << 52;
    int lowest_bit = exponent - 1075 + kFractionBits;  // place of the mantissa's last bit in the sum
    if (lowest_bit < 0) {
        mantissa = lowest_bit > -53 ? mantissa >> -lowest_bit : 0;
        lowest_bit = 0;
    }
    const int shift = lowest_bit & 31;
    const uint64_t low = (mantissa & kLow) << shift, high = (mantissa >> 32) << shift;
    const uint64_t parts[3] = {low & kLow, (low >> 32) + (high & kLow), high >> 32};
    const int64_t sign = -static_cast<int64_t>(bits >> 63);  // x ^ -1 minus -1 is -x
    int limb = lowest_bit >> 5;
    int64_t carry = 0;
    for (const uint64_t part : parts) {
        carry += static_cast<int64_t>(limbs[limb]) + (static_cast<int64_t>(part) ^ sign) - sign;
        limbs[limb++] = static_cast<uint32_t>(carry);
        carry >>= 32;
    }
    for (; carry != 0 && limb < kLimbs; ++limb) {
        carry += limbs[limb];
        limbs[limb] = static_cast<uint32_t>(carry);
        carry >>= 32;
    }
    return true;
}

// Adds each value to the sum of its group, limbs[kLimbs * group]. Returns false if one of them is too large or not
// finite.
inline bool add_exactly(size_t count, const double* values, const int64_t* groups, uint32_t* limbs) {
    bool accepted = true;
    for (size_t i = 0; i < count; ++i) accepted &= add_exactly(values[i], limbs + kLimbs * groups[i]);
    return accepted;
}

// The double nearest to a sum, with ties to even.
inline double round_exactly(const uint32_t* limbs) {
    const bool is_negative = limbs[kLimbs - 1] >> 31;
    uint32_t magnitude[kLimbs];
    uint64_t carry = is_negative;
    for (int k = 0; k < kLimbs; ++k) {
        carry += is_negative ? ~limbs[k] : limbs[k];
        magnitude[k] = static_cast<uint32_t>(carry);
        carry >>= 32;
    }
    int top = kLimbs - 1;
    while (top >= 0 && magnitude[top] == 0) --top;
    if (top < 0) return 0.0;
    const auto limb = [&](int k) { return k < 0 ? uint64_t{0} : uint64_t{magnitude[k]}; };
    // The leading 64 bits. Their last one is also set if any later bit is: it then decides ties, and nothing else.
    const int zeros = __builtin_clz(magnitude[top]);
    uint64_t leading = (limb(top) << 32 | limb(top - 1)) << zeros | limb(top - 2) >> (32 - zeros);
    uint64_t rest = limb(top - 2) << zeros & 0xffffffffu;
    for (int k = 0; k < top - 2; ++k) rest |= magnitude[k];
    leading |= rest != 0;
    const double rounded = std::ldexp(static_cast<double>(leading), 32 * (top - 1) - zeros - kFractionBits);
    return is_negative ? -rounded : rounded;
}

}  // namespace pcbench
