// The data of one rendering: the Gaussians, the camera, the splats and their tiles, and the images. Each kernel gets
// all of it and works on a part.
#pragma once
#include <cstddef>
#include <cstdint>

#include "pinhole.h"

namespace pcbench::splat {

constexpr int kTile = 16;  // pixels along a side of a tile
constexpr int kBlock = 4;  // pixels along a side of a block, which is one SIMD vector
constexpr int kBlocksAcross = kTile / kBlock;
constexpr int kTileBlocks = kBlocksAcross * kBlocksAcross;
constexpr int kTilePixels = kTile * kTile;
constexpr int kGroup = 256;       // Gaussians that are projected together
constexpr int kSplatFloats = 16;  // floats per stored splat: one cache line

// The Gaussians, row-major.
struct Model {
    int64_t count;
    const float *means, *quaternions, *scales, *opacities;
    const float* harmonics;  // (count, harmonic_count, 3)
    int harmonic_count;
};

// The tiles that the bounding box of a splat overlaps, inclusive. Splats are stored by slot, independent of depth
// order.
struct Box {
    int16_t left, top, right, bottom;  // tiles, inclusive
};

// One Gaussian in one tile.
struct Instance {
    uint32_t slot;
    uint32_t emission;  // index at which its sums over the tile's pixels are written
    uint32_t blocks;    // a bit for each block of the tile that it may touch
};

struct Images {
    float* color;          // (height, width, 3)
    float* transmittance;  // (height, width)
    float* depth;          // these and those that follow are null if they are not rendered
    float* normal;         // (height, width, 3)
    float* median_depth;
};

struct ImageGradients {  // with respect to the images; null for zero
    const float *color, *transmittance, *depth, *normal;
};

struct Frame {
    Model model;
    Pinhole pinhole;
    float background[3];
    int tiles_across, tiles_down;
    int geometry;  // kNoGeometry, kDepth or kNormals
    // By slot: group g of kGroup Gaussians has the slots from g * kGroup on, the first drawn[g] of which are in use.
    float* splats;
    float* depths;
    Box* boxes;
    uint32_t* ids;
    const int* drawn;
    // By tile.
    const Instance* instances;
    const uint32_t* starts;  // (tiles + 1,)
    Images images;
};

// The gradients with respect to the drawn Gaussians, row-major in the order of their slots.
struct ModelGradients {
    float *means, *quaternions, *scales, *opacities, *harmonics, *screen;
};

}  // namespace pcbench::splat
