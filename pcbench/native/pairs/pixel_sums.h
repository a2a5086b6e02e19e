// Sums of the distances of a map per pixel of a raster, seen from above.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "pairs/exact_sums.h"

namespace pcbench {

struct PixelGrid {
    double west, south, pixel;
    int64_t width, height;

    // Number of the pixel of a point, row by row from the south; -1 outside.
    int64_t pixel_of(const double* point) const {
        const double column = std::floor((point[0] - west) / pixel), row = std::floor((point[1] - south) / pixel);
        const bool inside =
            column >= 0 && column < static_cast<double>(width) && row >= 0 && row < static_cast<double>(height);
        return inside ? static_cast<int64_t>(row) * width + static_cast<int64_t>(column) : -1;
    }
};

// One entry for each pixel.
struct PixelSums {
    int64_t *counts, *signed_counts;
    uint32_t *limbs, *signed_limbs;  // exact sums
    double* largest;
};

// Adds distances of points, and their signed distances where these are finite, to the pixels of the points. Returns
// false if a distance is too large or not finite.
inline bool add_to_pixels(const PixelGrid& grid, size_t count, const double* points, const double* distances,
                          const double* signed_distances, const PixelSums& sums) {
    constexpr size_t kBlock = 64;
    bool accepted = true;
    int64_t pixels[kBlock];
    for (size_t start = 0; start < count; start += kBlock) {
        const size_t size = std::min(kBlock, count - start);
        for (size_t i = 0; i < size; ++i) {
            pixels[i] = grid.pixel_of(points + 3 * (start + i));
            if (pixels[i] < 0) continue;  // the sums of neighbouring points may be far apart in memory
            __builtin_prefetch(sums.counts + pixels[i], 1), __builtin_prefetch(sums.largest + pixels[i], 1);
            __builtin_prefetch(sums.limbs + kLimbs * pixels[i], 1);
            __builtin_prefetch(sums.signed_counts + pixels[i], 1);
            __builtin_prefetch(sums.signed_limbs + kLimbs * pixels[i], 1);
        }
        for (size_t i = 0; i < size; ++i) {
            const int64_t pixel = pixels[i];
            if (pixel < 0) continue;
            const double distance = distances[start + i], signed_distance = signed_distances[start + i];
            accepted &= add_exactly(distance, sums.limbs + kLimbs * pixel);
            ++sums.counts[pixel];
            sums.largest[pixel] = std::max(sums.largest[pixel], distance);
            if (!std::isfinite(signed_distance)) continue;
            accepted &= add_exactly(signed_distance, sums.signed_limbs + kLimbs * pixel);
            ++sums.signed_counts[pixel];
        }
    }
    return accepted;
}

}  // namespace pcbench
