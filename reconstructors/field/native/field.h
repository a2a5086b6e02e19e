// A voxel radiance field after Plenoxels (Fridovich-Keil et al. 2022): the vertices of a sparse grid hold a density and
// spherical harmonics of degree 1; between them they are interpolated trilinearly. Lengths are in voxels.
#pragma once
#include <cstddef>
#include <cstdint>

namespace pcbench::field {

// A vertex is a row of sixteen floats, one cache line: its density, then for each of four harmonics red, green and
// blue. The last three floats are unused.
constexpr int kChannels = 16;
constexpr int kBlock = 4;                   // cells along the edge of a block that is skipped if it is empty
constexpr float kColorOffset = 0.5f;        // color where all harmonics are 0
constexpr float kMinTransmittance = 1e-4f;  // a ray ends below it

struct Grid {
    const float* values;      // rows of the vertices
    const int32_t* links;     // row of each vertex (x, y, z) of the dense grid; -1 if it is empty
    const uint8_t* occupied;  // for each block of cells, whether rays sample it
    int size[3];              // vertices along x, y, z
    int blocks[3];            // blocks along x, y, z
    const float* background;  // row whose harmonics are the color behind the grid
    float step;               // length between two samples of a ray
};

// Samples are (k + offset) steps behind the point where the ray enters the grid, for whole k.
struct Ray {
    float origin[3], direction[3];  // direction is a unit vector
    float offset;
    float basis[kChannels];  // harmonics of the direction in the order of a row, and 1 for the density
    float background[3];     // color behind the grid
};

// A sample with a positive density.
struct Sample {
    int32_t vertex, x;    // lowest vertex of its cell: index in the dense grid, and position along x
    float fraction[3];    // position in the cell, 0 to 1
    float weight, after;  // blending weight, and transmittance behind the sample
    float channels[4];    // density, red, green, blue; after `pull_back`, the gradients with respect to them
};

// What a ray sees. `depth` is the sum of blending weights times distances; `median` the distance at which half of the
// light is absorbed, 0 if less is; `normal` the sum of blending weights times unit vectors against the density's
// gradient.
struct Pixel {
    float color[3], transmittance, depth, median, normal[3];
};

// The regularized vertices and the optimizer's state.
struct Update {
    float *values, *moments, *gradients;
    uint8_t* touched;         // whether a ray contributed to the gradient of a row
    const int32_t* vertices;  // vertex of each row in the dense grid
    const int32_t* links;
    int size[3];
    const float *rates, *smoothing;  // learning rate and weight of the total variation, one per channel
};

}  // namespace pcbench::field
