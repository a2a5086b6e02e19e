// Inputs made of whole numbers, and hashes of results: what the kernels give on one processor is compared with what
// they give on another, bit by bit. No input is rounded in a way that a compiler or a C library could choose.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <vector>

namespace golden {

// Numerical Recipes' 64-bit generator; its upper bits are used.
class Random {
public:
    explicit Random(uint64_t seed) : state_(seed) {}
    // A whole number from 0 to below `limit`, which is at most 2^31.
    int32_t below(uint32_t limit) {
        state_ = state_ * 6364136223846793005u + 1442695040888963407u;
        return static_cast<int32_t>((state_ >> 33) % limit);
    }
    // A multiple of 2^-16 from `low` to below `low + width`, both whole.
    double number(int low, int width) { return low + below(static_cast<uint32_t>(width) << 16) * 0x1p-16; }
    float single(int low, int width) {
        return static_cast<float>(low + below(static_cast<uint32_t>(width) << 12) * 0x1p-12);
    }

private:
    uint64_t state_;
};

// Prints the name and the FNV-1a hash of the bytes of arrays. NaN has another sign on each processor: it is an error.
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
