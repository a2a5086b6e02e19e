// What one image's depth map is searched for from, and the state of the search. Pixel (0, 0) has its centre at (0, 0).
#pragma once
#include <cstddef>
#include <cstdint>

#include "common/interrupt.h"

namespace pcbench::mvs {

constexpr int kMaxSources = 16;
constexpr int kMostSide = 32000;  // pixels: coordinates in a source are 16.16 fixed-point numbers
static_assert(int64_t{kMostSide} * kMostSide <= INT32_MAX,
              "pixels are numbered in 32 bits, what is stored of them in 64");
constexpr float kWorst = 2.0f;  // the cost of what cannot be compared: one less the smallest correlation

struct Source {
    const int32_t* quads = nullptr;  // of each pixel: itself, that to its right, that below, that below right, a signed
                                     // byte each: its grey level less 128
    int width = 0, height = 0;
    float turn[9] = {};            // K' R K^-1, from the reference's pixels to those of the source, of what is far away
    float shift[3] = {};           // K' t
    const float* shown = nullptr;  // 0 where a mask hides its picture; null: nowhere
    const float* depth = nullptr;  // its depth map where there is one: agreement with it then is part of the cost
    float back_turn[9] = {}, back_shift[3] = {};  // from its pixels to the reference's, as above
};

struct Problem {
    const uint8_t* gray = nullptr;
    const uint8_t* valid = nullptr;  // null: every pixel
    int width = 0, height = 0;
    float fx = 1, fy = 1, cx = 0, cy = 0;
    int source_count = 0;
    Source sources[kMaxSources];
    float nearest = 0, farthest = 0;  // of the depths that are looked for
    float pixels_per_depth = 0;  // how far the image of a point moves in a source, in pixels, while its inverse depth
                                 // changes by one
    float least_variance = 1;    // in grey levels squared: of a patch that shows texture, not noise
    uint32_t seed = 0;
    float space_weights[25] = {};  // of the patch's texels
    float gray_weights[256] = {};  // of texels that differ so much in grey level from the patch's middle
};

// A row for each pixel, row by row. A depth of 0 is none.
struct State {
    float* plane = nullptr;  // of each the depth and the normal's x, y, z
    float* cost = nullptr;
    float* view_costs = nullptr;  // source_count of each
    float* beside = nullptr;      // room for the costs of one colour
    int64_t beside_columns = 0;   // of that
};

// Beside: of the pixels of one colour of a chessboard, in each row those of every second column next to each other,
// with a border as wide as pixels and groups of them reach. What lies at the same distance from pixels of the other
// colour is then side by side too.
constexpr int kBesideAbove = 25, kBesideLeft = 13, kBesideRight = 29;

}  // namespace pcbench::mvs
