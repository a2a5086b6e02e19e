// Input of the search for one image's depth map, and its state. Pixel (0, 0) has its centre at (0, 0).
#pragma once
#include <cstddef>
#include <cstdint>

#include "common/interrupt.h"

namespace pcbench::mvs {

constexpr int kMaxSources = 16;
constexpr int kMaxSide = 32000;  // pixels: coordinates in a source are 16.16 fixed-point numbers
static_assert(int64_t{kMaxSide} * kMaxSide <= INT32_MAX,
              "pixel indices have 32 bits, offsets of stored values have 64");
constexpr float kMaxCost = 2.0f;  // one minus the smallest correlation; also the cost of planes that cannot be compared

struct Source {
    const int32_t* quads = nullptr;  // per pixel four signed bytes, grey level minus 128: the pixel itself, the next
                                     // to the right, the next below, and the one below right
    int width = 0, height = 0;
    float linear[9] = {};            // K' R K^-1: from pixels of the reference to pixels of the source at infinity
    float shift[3] = {};             // K' t
    const float* visible = nullptr;  // 0 where a mask hides the source; null without a mask
    const float* depth = nullptr;    // depth map of the source, null without one; agreement with it is part of the cost
    float back_linear[9] = {}, back_shift[3] = {};  // from pixels of the source to pixels of the reference
};

struct Problem {
    const uint8_t* gray = nullptr;
    const uint8_t* valid = nullptr;  // null if all pixels are valid
    int width = 0, height = 0;
    float fx = 1, fy = 1, cx = 0, cy = 0;
    int source_count = 0;
    Source sources[kMaxSources];
    float nearest = 0, farthest = 0;  // depth range of the search
    float pixels_per_depth = 0;       // displacement of a point in a source, in pixels per unit of inverse depth
    float min_variance = 1;           // variance of a patch with texture, in squared grey levels
    bool half_patches = false;        // whether patches have 13 instead of 25 texels, one colour of a chessboard
    uint32_t seed = 0;
    float space_weights[25] = {};  // per texel of a patch
    float gray_weights[256] = {};  // per absolute grey level difference from the patch's centre
};

// Arrays with one record per pixel, row by row. A depth of 0 means no plane.
struct State {
    float* plane = nullptr;  // depth and normal x, y, z
    float* cost = nullptr;
    float* view_costs = nullptr;    // source_count values per pixel
    float* packed_costs = nullptr;  // buffer for the costs of one colour
    int64_t packed_columns = 0;     // row length of that buffer
};

// Packed costs: the pixels of one chessboard colour, every second column of each row, stored contiguously. Neighbours
// at one offset from sixteen pixels of the other colour are then contiguous too. The border is as wide as the offsets.
constexpr int kPackedAbove = 25, kPackedLeft = 13, kPackedRight = 29;

}  // namespace pcbench::mvs
