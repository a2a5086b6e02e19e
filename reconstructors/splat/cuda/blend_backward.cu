// A warp a bucket, a lane a splat: the pixels of the tile go through the lanes one after the other, so that lane n
// meets a pixel a step after lane n - 1, takes from it how far the ray has come, and adds what the pixel says to sums
// that it alone holds. So nothing is added to the same place by two, and the order of each sum is that of the pixels.
//
// `emission` says where among the Gaussian's own instances each sorted instance was written, and so is its record.
// Where no derivative (of `by_`...) or error is given its pointer is null.

constexpr int kMoments = kGeometry ? 17 : 11;
constexpr int kWarps = kThreads / kLanes;
constexpr int kRing = 2 * kLanes;  // pixels at hand: those that are in the lanes, and the next

// What a pixel brings along. It is read by every lane in turn.
struct Pixels {
    float limit[kRing];                // how many of the bucket's splats it sees, the last one counted
    float left[kRing], behind[kRing];  // at the bucket's beginning
    float color[3][kRing], error[kRing];
    float depth[kGeometry ? kRing : 1], normal[3][kGeometry ? kRing : 1];
};

extern "C" __global__ void __launch_bounds__(kThreads)
    blend_backward(const Pinhole* camera, const float* background, const int* starts, const int* bucket_ends,
                   int tile_count, const int* gaussians, const long long* emission, const Stored* splats,
                   const float* borders, const float* ends, const int* reached, const float* by_color,
                   const float* by_transmittance, const float* by_depth, const float* by_normal, const float* errors,
                   float* records) {
    constexpr int kFloats = ray_floats(kGeometry);
    __shared__ Pixels shared[kWarps];
    const int lane = threadIdx.x % kLanes, bucket = blockIdx.x * kWarps + threadIdx.x / kLanes;
    if (bucket >= bucket_ends[tile_count - 1]) return;
    Pixels& ring = shared[threadIdx.x / kLanes];

    int tile = 0;  // the first whose buckets end behind this one
    for (int size = tile_count; size > 0;) {
        const int half = size / 2;
        const bool later = bucket_ends[tile + half] <= bucket;
        tile = later ? tile + half + 1 : tile;
        size = later ? size - half - 1 : half;
    }
    const int first = starts[tile], last = starts[tile + 1];
    const int begin = (bucket - bucket_ends[tile] + buckets_of(last - first)) * kLanes;  // within the tile
    const int mine = first + begin + lane;
    const bool any = mine < last;
    Splat<float> s = {};
    if (any) s = splats[gaussians[mine]].splat;
    const int width = camera->width, across = (width + kTile - 1) / kTile;
    const int left_x = tile % across * kTile, top_y = tile / across * kTile;
    const float* start_rays = borders + static_cast<long long>(bucket) * kFloats * kTilePixels;
    const float* end_rays = ends + static_cast<long long>(tile) * kFloats * kTilePixels;
    const int* seen_counts = reached + static_cast<long long>(tile) * kTilePixels;
    const Vec<float> behind_all = {background[0], background[1], background[2]};

    Moments<float> m = {};
    float left = 0.0f, behind = 0.0f;
    bool reaches = false;
    for (int pixel = lane; pixel < kTilePixels; pixel += kLanes) reaches = reaches || seen_counts[pixel] > begin;
    const int steps = __any_sync(kWarp, reaches) ? kTilePixels + kLanes - 1 : 0;
    for (int step = 0; step < steps; ++step) {
        if (step % kLanes == 0 && step < kTilePixels) {
            // The next 32 pixels, a lane each. None is seen beyond the image: `reached` is 0 there.
            const int pixel = step + lane, slot = pixel % kRing;
            const int limit = seen_counts[pixel] - begin;
            __syncwarp();
            ring.limit[slot] = static_cast<float>(min(max(limit, 0), kLanes));
            if (limit > 0) {
                const long long at = static_cast<long long>(top_y + pixel / kTile) * width + left_x + pixel % kTile;
                const Ray now = load_ray<kGeometry>(start_rays, pixel), end = load_ray<kGeometry>(end_rays, pixel);
                const Vec<float> color = {by_color[3 * at], by_color[3 * at + 1], by_color[3 * at + 2]};
                float by_end = dot(behind_all, color);
                if (by_transmittance != nullptr) by_end = by_end + by_transmittance[at];
                float ahead = fused(end.left, by_end, dot(end.color - now.color, color));
                ring.color[0][slot] = color.x, ring.color[1][slot] = color.y, ring.color[2][slot] = color.z;
                ring.error[slot] = errors != nullptr ? errors[at] : 0.0f;
                if (kGeometry) {
                    const float depth = by_depth != nullptr ? by_depth[at] : 0.0f;
                    Vec<float> normal = {0.0f, 0.0f, 0.0f};
                    if (by_normal != nullptr)
                        normal = {by_normal[3 * at], by_normal[3 * at + 1], by_normal[3 * at + 2]};
                    ahead = fused(end.depth - now.depth, depth, ahead + dot(end.normal - now.normal, normal));
                    ring.depth[slot] = depth;
                    ring.normal[0][slot] = normal.x, ring.normal[1][slot] = normal.y, ring.normal[2][slot] = normal.z;
                }
                ring.left[slot] = now.left;
                ring.behind[slot] = ahead;
            }
            __syncwarp();
        }
        left = __shfl_up_sync(kWarp, left, 1);
        behind = __shfl_up_sync(kWarp, behind, 1);
        const int pixel = step - lane, slot = pixel & (kRing - 1);
        if (pixel < 0 || pixel >= kTilePixels || !any || !(static_cast<float>(lane) < ring.limit[slot])) continue;
        if (lane == 0) left = ring.left[slot], behind = ring.behind[slot];
        const Seen seen = seen_of(s, static_cast<float>(left_x + pixel % kTile) + 0.5f,
                                  static_cast<float>(top_y + pixel / kTile) + 0.5f);
        const float alpha = lesser(seen.alpha, kMostAlpha);
        if (!(kLeastAlpha <= alpha)) continue;
        PixelGradient<float> by = {};
        by.color = {ring.color[0][slot], ring.color[1][slot], ring.color[2][slot]};
        if (kGeometry) {
            by.depth = ring.depth[slot];
            by.normal = {ring.normal[0][slot], ring.normal[1][slot], ring.normal[2][slot]};
        }
        const float free = seen.alpha < kMostAlpha ? 1.0f : 0.0f;
        add_pixel<kGeometry>(s, seen.u, seen.v, alpha, free, left, by, ring.error[slot], behind, m);
        left = fused(-left, alpha, left);
    }
    if (!any) return;
    float* out = records + emission[mine] * kMoments;
    out[0] = m.h, out[1] = m.hu, out[2] = m.hv, out[3] = m.huu, out[4] = m.huv, out[5] = m.hvv;
    out[6] = m.color.x, out[7] = m.color.y, out[8] = m.color.z, out[9] = m.weight, out[10] = m.error;
    if (kGeometry) {
        out[11] = m.depth, out[12] = m.depth_u, out[13] = m.depth_v;
        out[14] = m.normal.x, out[15] = m.normal.y, out[16] = m.normal.z;
    }
}
