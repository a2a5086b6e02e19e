// Projects a Gaussian and counts the tiles that its splat touches, one thread per Gaussian; 0 if it is not drawn.

__device__ inline int clamp_to_int(float x, int low, int high) {
    // NaN becomes `low`.
    return static_cast<float>(low) < x ? (x < static_cast<float>(high) ? static_cast<int>(x) : high) : low;
}

extern "C" __global__ void __launch_bounds__(kThreads)
    project_gaussians(const Pinhole* camera, int count, const float* means, const float* quaternions,
                      const float* scales, const float* opacities, const float* coefficients, Stored* splats,
                      Box* boxes, float* depths, int* tiles) {
    const Pinhole at = *camera;
    const int i = blockIdx.x * kThreads + threadIdx.x;
    Stored s = {};
    Box box = {};
    Footprint<float> f;
    bool drawn = false;
    if (i < count) {
        const GaussianRow g = load_gaussian(i, means, quaternions, scales, opacities);
        s.splat = project(at, g.mean, g.quaternion, g.scale, g.opacity, f, drawn);
        s.reach = f.reach;
        // Both comparisons are false for NaN.
        drawn = drawn && f.extent_x < kMaxExtent && f.extent_y < kMaxExtent;
    }
    if (drawn) {
        // The pixels whose centres lie within the ellipse's bounding box.
        const int left = clamp_to_int(ceilf(s.splat.x - f.extent_x - 0.5f), 0, at.width);
        const int right = clamp_to_int(floorf(s.splat.x + f.extent_x - 0.5f), -1, at.width - 1);
        const int top = clamp_to_int(ceilf(s.splat.y - f.extent_y - 0.5f), 0, at.height);
        const int bottom = clamp_to_int(floorf(s.splat.y + f.extent_y - 0.5f), -1, at.height - 1);
        drawn = left <= right && top <= bottom;
        box = {static_cast<short>(left / kTile), static_cast<short>(top / kTile), static_cast<short>(right / kTile),
               static_cast<short>(bottom / kTile)};
    }
    const int touched = for_each_tile(at, s, box, drawn, [](int, int, int) {});
    if (i >= count) return;
    tiles[i] = touched;
    if (touched == 0) return;
    float basis[kMaxHarmonics];
    harmonics(unit(f.offset), kHarmonics, basis);
    const float* c = coefficients + 3LL * kHarmonics * i;
    Vec<float> color = {0.5f, 0.5f, 0.5f};
    for (int k = 0; k < kHarmonics; ++k)
        color = fused(basis[k], Vec<float>{c[3 * k], c[3 * k + 1], c[3 * k + 2]}, color);
    s.splat.color = {greater(color.x, 0.0f), greater(color.y, 0.0f), greater(color.z, 0.0f)};
    splats[i] = s;
    boxes[i] = box;
    depths[i] = s.splat.depth;
}
