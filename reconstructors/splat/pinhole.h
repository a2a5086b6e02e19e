// The camera of the splats and the limits of what is drawn, included before maths.h: the same for every instruction set
// and device. It includes nothing.
#pragma once

struct Pinhole {
    float rotation[9];  // cam_from_world, row-major
    float position[3];  // of the camera in the world
    float fx, fy, cx, cy;
    float left, right, top, bottom;  // bounds to which x / z and y / z are clamped for the affine approximation
    float nearest;                   // depth up to which nothing is drawn
    float min_alpha, min_level;      // lower alphas are skipped; log2(min_alpha)
    float min_transmittance;         // a ray ends before its transmittance falls below
    int width, height;
};

// What is rendered beside colour and transmittance: nothing, the depth, or depth, normal and median depth.
constexpr int kNoGeometry = 0, kDepth = 1, kNormals = 2;
constexpr int kMomentFloats[] = {9, 12, 15};  // sums over pixels of one Gaussian in one tile, see Moments
