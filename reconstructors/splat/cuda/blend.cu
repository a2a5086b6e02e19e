// A block a tile, a thread a pixel, from front to back. `gaussians` are those of the tiles' instances, sorted; those of
// tile t are starts[t] .. starts[t + 1]. Where each bucket of a tile begins the rays are stored in `borders` (those of
// tile t are the buckets from bucket_ends[t - 1] on), as they end in `ends`; `reached` counts, for each pixel of each
// tile, the instances up to and with the last that it sees. The backward pass starts from these.

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
    ray.left = 1.0f;
    float median = 0.0f;
    int seen_last = 0;
    bool going = inside;
    for (int begin = first; begin < last; begin += kThreads) {
        // Also the barrier before the batch is written over.
        if (!__syncthreads_or(going)) break;
        const int size = min(kThreads, last - begin);
        if (pixel < size) batch[pixel] = splats[gaussians[begin + pixel]];
        __syncthreads();
        for (int k = 0; going && k < size; ++k) {
            const int n = begin + k - first;
            if (kBorders && n % kLanes == 0) {
                const long long at = bucket + n / kLanes;
                store_ray<kGeometry>(borders + at * kFloats * kTilePixels, pixel, ray);
            }
            const Splat<float> s = batch[k].splat;
            const Seen seen = seen_of(s, center_x, center_y);
            const float alpha = lesser(seen.alpha, kMostAlpha);
            if (!(kLeastAlpha <= alpha)) continue;
            const float next = fused(-ray.left, alpha, ray.left);
            if (next < kLeastTransmittance) {
                going = false;
                break;
            }
            const float weight = ray.left * alpha;
            ray.color = fused(weight, s.color, ray.color);
            if (kGeometry) {
                const float plane = fused(s.depth_u, seen.u, fused(s.depth_v, seen.v, s.depth));
                ray.depth = fused(weight, plane, ray.depth);
                ray.normal = fused(weight, s.normal, ray.normal);
                if (0.5f <= ray.left && next < 0.5f) median = plane;
            }
            ray.left = next;
            seen_last = n + 1;
        }
    }

    if (kBorders) {
        reached[static_cast<long long>(tile) * kTilePixels + pixel] = seen_last;
        store_ray<kGeometry>(ends + static_cast<long long>(tile) * kFloats * kTilePixels, pixel, ray);
    }
    if (!inside) return;
    const long long at = static_cast<long long>(y) * width + x;
    transmittance[at] = ray.left;
    color[3 * at] = fused(ray.left, background[0], ray.color.x);
    color[3 * at + 1] = fused(ray.left, background[1], ray.color.y);
    color[3 * at + 2] = fused(ray.left, background[2], ray.color.z);
    if (kGeometry) {
        depth[at] = ray.depth;
        normal[3 * at] = ray.normal.x, normal[3 * at + 1] = ray.normal.y, normal[3 * at + 2] = ray.normal.z;
        median_depth[at] = median;
    }
}
