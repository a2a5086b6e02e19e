// Integer-based inputs and hashes of results, to compare kernels bit by bit between processors. No input depends on the
// rounding of a compiler or of a C library.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <vector>

namespace golden {

// The 64-bit linear congruential generator of Numerical Recipes; only its upper bits are used.
class Random {
public:
    explicit Random(uint64_t seed) : state_(seed) {}
    // Returns an integer in [0, limit), with limit <= 2^31.
    int32_t below(uint32_t limit) {
        state_ = state_ * 6364136223846793005u + 1442695040888963407u;
        return static_cast<int32_t>((state_ >> 33) % limit);
    }
    // Returns a multiple of 2^-16 in [low, low + width).
    double uniform(int low, int width) { return low + below(static_cast<uint32_t>(width) << 16) * 0x1p-16; }
    // The same in single precision, a multiple of 2^-12.
    float uniform_float(int low, int width) {
        return static_cast<float>(low + below(static_cast<uint32_t>(width) << 12) * 0x1p-12);
    }

private:
    uint64_t state_;
};

// Prints the name and the FNV-1a hash of the bytes of arrays. NaN counts as an error: its sign depends on the
// processor.
class Hash {
public:
    explicit Hash(const char* name) : name_(name) {}
    ~Hash() { std::printf("%s %016llx%s\n", name_, static_cast<unsigned long long>(hash_), nan_ ? " NaN" : ""); }
    template <typename T>
    Hash& add(const std::vector<T>& values) {
        for (const T& value : values) nan_ = nan_ || value != value;
        const auto* bytes = reinterpret_cast<const unsigned char*>(values.data());
        for (size_t i = 0; i < values.size() * sizeof(T); ++i) hash_ = (hash_ ^ bytes[i]) * 0x100000001b3u;
        return *this;
    }

private:
    const char* name_;
    uint64_t hash_ = 0xcbf29ce484222325u;
    bool nan_ = false;
};

void points();
void mesh();
void pairs();
void patchmatch();
void splats();

}  // namespace golden
