// One warp per bucket, one lane per splat: the pixels of the tile pass through the lanes one after the other. Lane n
// gets a pixel one step after lane n - 1, with the state of its ray, and adds the pixel's contribution to sums in its
// own registers. So no two threads add to the same value, and the order of each sum is that of the pixels.
//
// `emission` is the index at which a sorted instance was written among those of its Gaussian; its record is written
// there. The pointer of a gradient (`grad_`...) that is not given is null.

constexpr int kMoments = kMomentFloats[kGeometry];
constexpr int kWarps = kThreads / kLanes;
constexpr int kRing = 2 * kLanes;  // buffered pixels: those in the lanes, and the next ones

// The data of the buffered pixels, which all lanes read in turn.
struct Pixels {
    float limit[kRing];                         // number of the bucket's splats up to the last that contributes
    float transmittance[kRing], behind[kRing];  // see add_pixel; at the start of the bucket
    float color[3][kRing];
    float depth[kGeometry >= kDepth ? kRing : 1], normal[3][kGeometry >= kNormals ? kRing : 1];
};

extern "C" __global__ void __launch_bounds__(kThreads)
    blend_backward(const Pinhole* camera, const float* background, const int* starts, const int* bucket_ends,
                   int tile_count, const int* gaussians, const long long* emission, const Stored* splats,
                   const float* borders, const float* ends, const int* reached, const float* grad_color,
                   const float* grad_transmittance, const float* grad_depth, const float* grad_normal, float* records) {
    constexpr int kFloats = ray_floats(kGeometry);
    __shared__ Pixels shared[kWarps];
    const int lane = threadIdx.x % kLanes, bucket = blockIdx.x * kWarps + threadIdx.x / kLanes;
    if (bucket >= bucket_ends[tile_count - 1]) return;
    Pixels& ring = shared[threadIdx.x / kLanes];

    int tile = 0;  // the first tile whose buckets end after this one
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
    float transmittance = 0.0f, behind = 0.0f;
    bool reaches = false;
    for (int pixel = lane; pixel < kTilePixels; pixel += kLanes) reaches = reaches || seen_counts[pixel] > begin;
    const int steps = __any_sync(kWarp, reaches) ? kTilePixels + kLanes - 1 : 0;
    for (int step = 0; step < steps; ++step) {
        if (step % kLanes == 0 && step < kTilePixels) {
            // The next 32 pixels, one per lane. Pixels beyond the image have `reached` = 0.
            const int pixel = step + lane, slot = pixel % kRing;
            const int limit = seen_counts[pixel] - begin;
            __syncwarp();
            ring.limit[slot] = static_cast<float>(min(max(limit, 0), kLanes));
            if (limit > 0) {
                const long long at = static_cast<long long>(top_y + pixel / kTile) * width + left_x + pixel % kTile;
                const Ray now = load_ray<kGeometry>(start_rays, pixel), end = load_ray<kGeometry>(end_rays, pixel);
                const Vec<float> color = {grad_color[3 * at], grad_color[3 * at + 1], grad_color[3 * at + 2]};
                float grad_end = dot(behind_all, color);
                if (grad_transmittance != nullptr) grad_end = grad_end + grad_transmittance[at];
                float ahead = fused(end.transmittance, grad_end, dot(end.color - now.color, color));
                ring.color[0][slot] = color.x, ring.color[1][slot] = color.y, ring.color[2][slot] = color.z;
                if (kGeometry >= kNormals) {
                    Vec<float> normal = {0.0f, 0.0f, 0.0f};
                    if (grad_normal != nullptr)
                        normal = {grad_normal[3 * at], grad_normal[3 * at + 1], grad_normal[3 * at + 2]};
                    ahead = ahead + dot(end.normal - now.normal, normal);
                    ring.normal[0][slot] = normal.x, ring.normal[1][slot] = normal.y, ring.normal[2][slot] = normal.z;
                }
                if (kGeometry >= kDepth) {
                    const float depth = grad_depth != nullptr ? grad_depth[at] : 0.0f;
                    ahead = fused(end.depth - now.depth, depth, ahead);
                    ring.depth[slot] = depth;
                }
                ring.transmittance[slot] = now.transmittance;
                ring.behind[slot] = ahead;
            }
            __syncwarp();
        }
        transmittance = __shfl_up_sync(kWarp, transmittance, 1);
        behind = __shfl_up_sync(kWarp, behind, 1);
        const int pixel = step - lane, slot = pixel & (kRing - 1);
        if (pixel < 0 || pixel >= kTilePixels || !any || !(static_cast<float>(lane) < ring.limit[slot])) continue;
        if (lane == 0) transmittance = ring.transmittance[slot], behind = ring.behind[slot];
        const SplatSample sample = sample_splat(s, static_cast<float>(left_x + pixel % kTile) + 0.5f,
                                                static_cast<float>(top_y + pixel / kTile) + 0.5f);
        const float alpha = lesser(sample.alpha, kMaxAlpha);
        if (!(camera->min_alpha <= alpha)) continue;
        PixelGradient<float> grad = {};
        grad.color = {ring.color[0][slot], ring.color[1][slot], ring.color[2][slot]};
        if (kGeometry >= kDepth) grad.depth = ring.depth[slot];
        if (kGeometry >= kNormals) grad.normal = {ring.normal[0][slot], ring.normal[1][slot], ring.normal[2][slot]};
        add_pixel<kGeometry>(s, sample.u, sample.v, alpha, sample.alpha < kMaxAlpha, transmittance, grad, behind, m);
        transmittance = fused(-transmittance, alpha, transmittance);
    }
    if (!any) return;
    float* out = records + emission[mine] * kMoments;
    out[0] = m.h, out[1] = m.hu, out[2] = m.hv, out[3] = m.huu, out[4] = m.huv, out[5] = m.hvv;
    out[6] = m.color.x, out[7] = m.color.y, out[8] = m.color.z;
    if (kGeometry >= kDepth) out[9] = m.depth, out[10] = m.depth_u, out[11] = m.depth_v;
    if (kGeometry >= kNormals) out[12] = m.normal.x, out[13] = m.normal.y, out[14] = m.normal.z;
}
