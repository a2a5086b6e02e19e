// What one rendering holds: the Gaussians, the camera, what of them is drawn where, and the pictures. Kernels get it
// whole and work on a part of it each.
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
constexpr int kGroup = 256;             // Gaussians that are projected at once
constexpr int kSplatFloats = 16;        // a splat in memory: a cache line
constexpr int kPlainMomentFloats = 11;  // the sums over pixels of one Gaussian in one tile
constexpr int kMomentFloats = 17;       // the same with geometry

// The Gaussians, by rows.
struct Model {
    int64_t count;
    const float *means, *quaternions, *scales, *opacities;
    const float* harmonics;  // (count, harmonic_count, 3)
    int harmonic_count;
};

// A drawn splat: its place in the order of depth is a number of its own, its slot is where it is stored.
struct Box {
    int16_t left, top, right, bottom;  // tiles, inclusive
};

// One Gaussian in one tile.
struct Instance {
    uint32_t slot;
    uint32_t emission;  // where its sums over the tile's pixels are written
    uint32_t blocks;    // a bit for each block of the tile that it may touch
};

struct Pictures {
    float* color;          // (height, width, 3)
    float* transmittance;  // (height, width)
    float* depth;          // those from here are null without geometry
    float* normal;         // (height, width, 3)
    float* median_depth;
};

struct PictureGradients {  // by the pictures; null for zero
    const float *color, *transmittance, *depth, *normal;
    const float* error;  // no derivative: what the error sums weigh
};

struct Frame {
    Model model;
    Pinhole pinhole;
    float background[3];
    int tiles_across, tiles_down;
    bool geometry;
    // By slot: group g of kGroup Gaussians has the slots from g * kGroup on, of which drawn[g] are in use.
    float* splats;
    float* depths;
    Box* boxes;
    uint32_t* ids;
    const int* drawn;
    // By tile.
    const Instance* instances;
    const uint32_t* starts;  // (tiles + 1,)
    Pictures pictures;
};

// The derivatives by the drawn Gaussians, by rows in the order of their slots.
struct ModelGradients {
    float *means, *quaternions, *scales, *opacities, *harmonics, *screen, *weight, *error;
};

}  // namespace pcbench::splat
