// What both kernels of the loss share: tiles of an image's channel, and the Gaussian window of SSIM (Wang et al. 2004),
// 11 pixels across with a standard deviation of 1.5 and zeros beyond the border.

constexpr int kTile = 16, kReach = 5, kWide = kTile + 2 * kReach;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
static_assert(kThreads == kTile * kTile, "a thread a pixel");

// exp(-k^2 / 2 / 1.5^2), of sum 1 over k = -5 .. 5.
__device__ inline float window_at(int k) {
    constexpr float kWindow[2 * kReach + 1] = {0.00102838012f, 0.00759875821f, 0.0360007733f, 0.109360688f,
                                               0.213005528f,   0.266011721f,   0.213005528f,  0.109360688f,
                                               0.0360007733f,  0.00759875821f, 0.00102838012f};
    return kWindow[k + kReach];
}

// A block's tile of one channel, one block a channel, a tile and a row of tiles.
struct Place {
    int channel, left, top;
};
__device__ inline Place place_of(int width) {
    const int across = (width + kTile - 1) / kTile, tile = blockIdx.x / 3;
    return {static_cast<int>(blockIdx.x % 3), tile % across * kTile, tile / across * kTile};
}

// A tile with its surroundings, and the same with the window taken across.
template <int kMaps>
struct Surroundings {
    float values[kMaps][kWide][kWide];
};
template <int kMaps>
struct Across {
    float sums[kMaps][kWide][kTile];
};

template <int kMaps>
__device__ inline void down(const Across<kMaps>& across, int x, int y, float* out) {
    for (int map = 0; map < kMaps; ++map) {
        float sum = 0.0f;
        for (int k = -kReach; k <= kReach; ++k) sum = fused(window_at(k), across.sums[map][y + kReach + k][x], sum);
        out[map] = sum;
    }
}
