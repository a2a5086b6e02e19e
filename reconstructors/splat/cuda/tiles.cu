// Tiles of 16 x 16 pixels, and what every kernel that looks at splats shares.

constexpr int kTile = 16;
constexpr int kTilePixels = kTile * kTile;
constexpr float kMostExtent = 1e8f;  // pixels: what is larger has no image that could be told

// A splat as it is stored.
struct alignas(16) Stored {
    Splat<float> splat;
    float reach;  // u^2 + v^2 at its ellipse's edge
};

// Tiles, all inclusive.
struct Box {
    short left, top, right, bottom;
};

__device__ inline int tiles_across(const Pinhole& at) { return (at.width + kTile - 1) / kTile; }

// Whether one of a tile's pixels may be touched. The slack keeps a tile whose nearest pixel rounding has put just
// outside.
__device__ inline bool touches(const Pinhole& at, const Stored& s, int column, int row) {
    const int right = min(column * kTile + kTile, at.width) - 1, bottom = min(row * kTile + kTile, at.height) - 1;
    const float x0 = static_cast<float>(column * kTile) + 0.5f - s.splat.x,
                x1 = static_cast<float>(right) + 0.5f - s.splat.x;
    const float y0 = static_cast<float>(row * kTile) + 0.5f - s.splat.y,
                y1 = static_cast<float>(bottom) + 0.5f - s.splat.y;
    return least_square(s.splat.uu, s.splat.uv, s.splat.vv, x0, x1, y0, y1) <= s.reach * 1.0001f + 1e-3f;
}

// Calls each(lane, n, tile) for the n-th tile that the lane's splat touches, row by row, and returns how many the
// calling lane's own touches. The whole warp goes through its lanes' splats one after the other, 32 tiles at a time, so
// that a splat all over the image holds nobody up. Every lane of the warp has to come; one without a splat has `any`
// false.
template <class Each>
__device__ inline int for_each_tile(const Pinhole& at, const Stored& mine, const Box& box, bool any, Each each) {
    const int lane = threadIdx.x % kLanes;
    const int across = tiles_across(at);
    int count = 0;
    for (unsigned left = __ballot_sync(kWarp, any); left != 0; left &= left - 1) {
        const int owner = __ffs(static_cast<int>(left)) - 1;
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
            if (touched) each(owner, found + __popc(mask & ((1u << lane) - 1u)), row * across + column);
            found += __popc(mask);
        }
        if (lane == owner) count = found;
    }
    return count;
}

// What a pixel sees of a splat: whitened coordinates, and alpha before it is held.
struct Seen {
    float u, v, alpha;
};
__device__ inline Seen seen_of(const Splat<float>& s, float x, float y) {
    const float dx = x - s.x, dy = y - s.y;
    const float u = fused(s.uu, dx, s.uv * dy), v = s.vv * dy;
    return {u, v, alpha_at(s.level, u, v)};
}

// The sums along a ray, as far as it has come.
struct Ray {
    float left;  // transmittance
    Vec<float> color;
    float depth;  // this and the normal are stored where geometry is wanted
    Vec<float> normal;
};
__device__ constexpr int ray_floats(bool geometry) { return geometry ? 8 : 4; }

// A tile's rays are stored number by number, so that neighbours lie side by side.
template <bool kWithGeometry>
__device__ inline void store_ray(float* to, int pixel, const Ray& ray) {
    to += pixel;
    to[0] = ray.left;
    to[kTilePixels] = ray.color.x, to[2 * kTilePixels] = ray.color.y, to[3 * kTilePixels] = ray.color.z;
    if (!kWithGeometry) return;
    to[4 * kTilePixels] = ray.depth;
    to[5 * kTilePixels] = ray.normal.x, to[6 * kTilePixels] = ray.normal.y, to[7 * kTilePixels] = ray.normal.z;
}
template <bool kWithGeometry>
__device__ inline Ray load_ray(const float* from, int pixel) {
    from += pixel;
    Ray ray = {};
    ray.left = from[0];
    ray.color = {from[kTilePixels], from[2 * kTilePixels], from[3 * kTilePixels]};
    if (!kWithGeometry) return ray;
    ray.depth = from[4 * kTilePixels];
    ray.normal = {from[5 * kTilePixels], from[6 * kTilePixels], from[7 * kTilePixels]};
    return ray;
}

// Of every 32 splats of a tile, a bucket, a warp later finds the derivative.
__device__ inline int buckets_of(int instances) { return (instances + kLanes - 1) / kLanes; }

// One Gaussian as it is given.
struct Given {
    Vec<float> mean, scale;
    Quaternion<float> quaternion;
    float opacity;
};
__device__ inline Given given_at(long long i, const float* means, const float* quaternions, const float* scales,
                                 const float* opacities) {
    const float *m = means + 3 * i, *q = quaternions + 4 * i, *s = scales + 3 * i;
    return {{m[0], m[1], m[2]}, {s[0], s[1], s[2]}, {q[0], q[1], q[2], q[3]}, opacities[i]};
}
