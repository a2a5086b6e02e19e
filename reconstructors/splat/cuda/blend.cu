// Blends front to back, one block per tile, one thread per pixel. `gaussians` are those of the sorted instances; the
// instances of tile t are starts[t] .. starts[t + 1]. For the backward pass the state of the rays is stored in
// `borders` at the start of each bucket (the buckets of tile t start at bucket_ends[t - 1]) and in `ends` at the end of
// the tile; `reached` is, for each pixel of each tile, the number of instances up to and including the last that
// contributes.

extern "C" __global__ void __launch_bounds__(kThreads)
    blend(const Pinhole* camera, const float* background, const int* starts, const int* bucket_ends,
          const int* gaussians, const Stored* splats, float* color, float* transmittance, float* depth, float* normal,
          float* median_depth, float* borders, float* ends, int* reached) {
    constexpr int kFloats = ray_floats(kGeometry);
    __shared__ Stored batch[kThreads];
    const int width = camera->width, height = camera->height, across = (width + kTile - 1) / kTile;
    const int tile = blockIdx.x, pixel = threadIdx.x;
    const int x = tile % across * kTile + pixel % kTile, y = tile / across * kTile + pixel / kTile;
    const float center_x = static_cast<float>(x) + 0.5f, center_y = static_cast<float>(y) + 0.5f;
    const int first = starts[tile], last = starts[tile + 1];
    const int bucket = bucket_ends[tile] - buckets_of(last - first);
    const bool inside = x < width && y < height;

    Ray ray = {};
    ray.transmittance = 1.0f;
    float median = 0.0f;
    int seen_last = 0;
    bool active = inside;
    for (int begin = first; begin < last; begin += kThreads) {
        // The barrier also protects the batch, which is overwritten below.
        if (!__syncthreads_or(active)) break;
        const int size = min(kThreads, last - begin);
        if (pixel < size) batch[pixel] = splats[gaussians[begin + pixel]];
        __syncthreads();
        for (int k = 0; active && k < size; ++k) {
            const int n = begin + k - first;
            if (kBorders && n % kLanes == 0) {
                const long long at = bucket + n / kLanes;
                store_ray<kGeometry>(borders + at * kFloats * kTilePixels, pixel, ray);
            }
            const Splat<float> s = batch[k].splat;
            const SplatSample sample = sample_splat(s, center_x, center_y);
            const float alpha = lesser(sample.alpha, kMaxAlpha);
            if (!(camera->min_alpha <= alpha)) continue;
            const float next = fused(-ray.transmittance, alpha, ray.transmittance);
            if (next < camera->min_transmittance) {
                active = false;
                break;
            }
            const float weight = ray.transmittance * alpha;
            ray.color = fused(weight, s.color, ray.color);
            if (kGeometry >= kDepth) {
                const float plane = fused(s.depth_u, sample.u, fused(s.depth_v, sample.v, s.depth));
                ray.depth = fused(weight, plane, ray.depth);
                if (kGeometry >= kNormals) {
                    ray.normal = fused(weight, s.normal, ray.normal);
                    if (0.5f <= ray.transmittance && next < 0.5f) median = plane;
                }
            }
            ray.transmittance = next;
            seen_last = n + 1;
        }
    }

    if (kBorders) {
        reached[static_cast<long long>(tile) * kTilePixels + pixel] = seen_last;
        store_ray<kGeometry>(ends + static_cast<long long>(tile) * kFloats * kTilePixels, pixel, ray);
    }
    if (!inside) return;
    const long long at = static_cast<long long>(y) * width + x;
    transmittance[at] = ray.transmittance;
    color[3 * at] = fused(ray.transmittance, background[0], ray.color.x);
    color[3 * at + 1] = fused(ray.transmittance, background[1], ray.color.y);
    color[3 * at + 2] = fused(ray.transmittance, background[2], ray.color.z);
    if (kGeometry >= kDepth) depth[at] = ray.depth;
    if (kGeometry >= kNormals) {
        normal[3 * at] = ray.normal.x, normal[3 * at + 1] = ray.normal.y, normal[3 * at + 2] = ray.normal.z;
        median_depth[at] = median;
    }
}
