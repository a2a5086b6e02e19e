// Tiles of 16 x 16 pixels, and functions shared by the kernels that read splats.

constexpr int kTile = 16;
constexpr int kTilePixels = kTile * kTile;
constexpr float kMaxExtent = 1e8f;  // pixels: larger projections are not drawn

// A splat as it is stored.
struct alignas(16) Stored {
    Splat<float> splat;
    float reach;  // u^2 + v^2 at its ellipse's edge
};

// The tiles that the bounding box of a splat overlaps, inclusive.
struct Box {
    short left, top, right, bottom;
};

__device__ inline int tiles_across(const Pinhole& at) { return (at.width + kTile - 1) / kTile; }

// Whether a splat may touch any pixel of a tile. The slack keeps a tile whose nearest pixel lies just outside by
// rounding.
__device__ inline bool touches(const Pinhole& at, const Stored& s, int column, int row) {
    const int right = min(column * kTile + kTile, at.width) - 1, bottom = min(row * kTile + kTile, at.height) - 1;
    const float x0 = static_cast<float>(column * kTile) + 0.5f - s.splat.x,
                x1 = static_cast<float>(right) + 0.5f - s.splat.x;
    const float y0 = static_cast<float>(row * kTile) + 0.5f - s.splat.y,
                y1 = static_cast<float>(bottom) + 0.5f - s.splat.y;
    return min_squared_norm(s.splat.uu, s.splat.uv, s.splat.vv, x0, x1, y0, y1) <= s.reach * 1.0001f + 1e-3f;
}

// Calls visit(lane, n, tile) for the n-th tile that the lane's splat touches, row by row, and returns the number of
// tiles of the calling lane's own splat. The warp processes the splats of its lanes one after the other, 32 tiles at a
// time, so that a splat across the whole image does not stall one lane. All lanes of the warp must call it; `any` is
// false for a lane without a splat.
template <class Visit>
__device__ inline int for_each_tile(const Pinhole& at, const Stored& mine, const Box& box, bool any, Visit visit) {
    const int lane = threadIdx.x % kLanes;
    const int across = tiles_across(at);
    int count = 0;
    for (unsigned lanes = __ballot_sync(kWarp, any); lanes != 0; lanes &= lanes - 1) {
        const int owner = __ffs(static_cast<int>(lanes)) - 1;
        Stored s;
        s.splat.x = __shfl_sync(kWarp, mine.splat.x, owner), s.splat.y = __shfl_sync(kWarp, mine.splat.y, owner);
        s.splat.uu = __shfl_sync(kWarp, mine.splat.uu, owner), s.splat.uv = __shfl_sync(kWarp, mine.splat.uv, owner);
        s.splat.vv = __shfl_sync(kWarp, mine.splat.vv, owner), s.reach = __shfl_sync(kWarp, mine.reach, owner);
        const int first_column = __shfl_sync(kWarp, static_cast<int>(box.left), owner);
        const int first_row = __shfl_sync(kWarp, static_cast<int>(box.top), owner);
        const int columns = __shfl_sync(kWarp, box.right - box.left + 1, owner);
        const int tiles = __shfl_sync(kWarp, box.bottom - box.top + 1, owner) * columns;
        int found = 0;
        for (int base = 0; base < tiles; base += kLanes) {
            const int k = base + lane;
            const int column = first_column + k % columns, row = first_row + k / columns;
            const bool touched = k < tiles && touches(at, s, column, row);
            const unsigned mask = __ballot_sync(kWarp, touched);
            if (touched) visit(owner, found + __popc(mask & ((1u << lane) - 1u)), row * across + column);
            found += __popc(mask);
        }
        if (lane == owner) count = found;
    }
    return count;
}

// A splat at a pixel: whitened coordinates, and alpha before clamping.
struct SplatSample {
    float u, v, alpha;
};
__device__ inline SplatSample sample_splat(const Splat<float>& s, float x, float y) {
    const float dx = x - s.x, dy = y - s.y;
    const float u = fused(s.uu, dx, s.uv * dy), v = s.vv * dy;
    return {u, v, alpha_at(s.level, u, v)};
}

// The accumulated values along a ray.
struct Ray {
    float transmittance;
    Vec<float> color;
    float depth;  // this and the normal are stored only if they are rendered
    Vec<float> normal;
};
__device__ constexpr int ray_floats(int geometry) { return geometry == kNoGeometry ? 4 : geometry == kDepth ? 5 : 8; }

// The rays of a tile are stored value by value, so that the values of neighbouring pixels are contiguous.
template <int kOfGeometry>
__device__ inline void store_ray(float* to, int pixel, const Ray& ray) {
    to += pixel;
    to[0] = ray.transmittance;
    to[kTilePixels] = ray.color.x, to[2 * kTilePixels] = ray.color.y, to[3 * kTilePixels] = ray.color.z;
    if (kOfGeometry >= kDepth) to[4 * kTilePixels] = ray.depth;
    if (kOfGeometry < kNormals) return;
    to[5 * kTilePixels] = ray.normal.x, to[6 * kTilePixels] = ray.normal.y, to[7 * kTilePixels] = ray.normal.z;
}
template <int kOfGeometry>
__device__ inline Ray load_ray(const float* from, int pixel) {
    from += pixel;
    Ray ray = {};
    ray.transmittance = from[0];
    ray.color = {from[kTilePixels], from[2 * kTilePixels], from[3 * kTilePixels]};
    if (kOfGeometry >= kDepth) ray.depth = from[4 * kTilePixels];
    if (kOfGeometry < kNormals) return ray;
    ray.normal = {from[5 * kTilePixels], from[6 * kTilePixels], from[7 * kTilePixels]};
    return ray;
}

// The number of buckets of a tile: each has 32 splats, whose gradient one warp computes.
__device__ inline int buckets_of(int instances) { return (instances + kLanes - 1) / kLanes; }

// The parameters of one Gaussian.
struct GaussianRow {
    Vec<float> mean, scale;
    Quaternion<float> quaternion;
    float opacity;
};
__device__ inline GaussianRow load_gaussian(long long i, const float* means, const float* quaternions,
                                            const float* scales, const float* opacities) {
    const float *m = means + 3 * i, *q = quaternions + 4 * i, *s = scales + 3 * i;
    return {{m[0], m[1], m[2]}, {s[0], s[1], s[2]}, {q[0], q[1], q[2], q[3]}, opacities[i]};
}
