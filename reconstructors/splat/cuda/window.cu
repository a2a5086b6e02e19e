// Shared by both kernels of the loss: tiles of one channel of an image, and the Gaussian window of SSIM (Wang et al.
// 2004), 11 pixels across with a standard deviation of 1.5 and zeros beyond the border.

constexpr int kTile = 16, kRadius = 5, kPadded = kTile + 2 * kRadius;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
static_assert(kThreads == kTile * kTile, "expected one thread per pixel");

// exp(-k^2 / 2 / 1.5^2), normalized to sum 1 over k = -5 .. 5.
__device__ inline float window_at(int k) {
    constexpr float kWindow[2 * kRadius + 1] = {0.00102838012f, 0.00759875821f, 0.0360007733f, 0.109360688f,
                                                0.213005528f,   0.266011721f,   0.213005528f,  0.109360688f,
                                                0.0360007733f,  0.00759875821f, 0.00102838012f};
    return kWindow[k + kRadius];
}

// The tile and the channel of a block; the blocks of the three channels of a tile are consecutive.
struct ChannelTile {
    int channel, left, top;
};
__device__ inline ChannelTile channel_tile(int width) {
    const int across = (width + kTile - 1) / kTile, tile = blockIdx.x / 3;
    return {static_cast<int>(blockIdx.x % 3), tile % across * kTile, tile / across * kTile};
}

// A tile with its margins, and the same after the horizontal window.
template <int kMaps>
struct Surroundings {
    float values[kMaps][kPadded][kPadded];
};
template <int kMaps>
struct Across {
    float sums[kMaps][kPadded][kTile];
};

template <int kMaps>
__device__ inline void down(const Across<kMaps>& across, int x, int y, float* out) {
    for (int map = 0; map < kMaps; ++map) {
        float sum = 0.0f;
        for (int k = -kRadius; k <= kRadius; ++k) sum = fused(window_at(k), across.sums[map][y + kRadius + k][x], sum);
        out[map] = sum;
    }
}
