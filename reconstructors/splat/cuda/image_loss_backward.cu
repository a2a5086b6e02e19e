// The loss's derivative by the image: the window is its own adjoint. `by_similarity` and `by_difference` are the
// derivatives by one pixel's similarity and absolute difference.

extern "C" __global__ void __launch_bounds__(kThreads)
    image_loss_backward(int width, int height, float by_similarity, float by_difference, const float* image,
                        const float* target, const float* by_mean, const float* by_square, const float* by_product,
                        float* gradient) {
    __shared__ Surroundings<3> near;
    __shared__ Across<3> across;
    const Place place = place_of(width);
    const int thread = threadIdx.x, x = thread % kTile, y = thread / kTile;
    for (int n = thread; n < kWide * kWide; n += kThreads) {
        const int column = place.left + n % kWide - kReach, row = place.top + n / kWide - kReach;
        const bool inside = 0 <= column && column < width && 0 <= row && row < height;
        const long long at = 3 * (static_cast<long long>(row) * width + column) + place.channel;
        near.values[0][n / kWide][n % kWide] = inside ? by_mean[at] : 0.0f;
        near.values[1][n / kWide][n % kWide] = inside ? by_square[at] : 0.0f;
        near.values[2][n / kWide][n % kWide] = inside ? by_product[at] : 0.0f;
    }
    __syncthreads();
    for (int n = thread; n < 3 * kWide * kTile; n += kThreads) {
        const int map = n / (kWide * kTile), row = n / kTile % kWide, column = n % kTile;
        float sum = 0.0f;
        for (int k = -kReach; k <= kReach; ++k)
            sum = fused(window_at(k), near.values[map][row][column + kReach + k], sum);
        across.sums[map][row][column] = sum;
    }
    __syncthreads();
    if (place.left + x >= width || place.top + y >= height) return;
    float sums[3];
    down(across, x, y, sums);
    const long long at = 3 * (static_cast<long long>(place.top + y) * width + place.left + x) + place.channel;
    const float p = image[at], q = target[at];
    const float similarity = fused(2.0f * p, sums[1], fused(q, sums[2], sums[0]));
    const float sign = q < p ? by_difference : p < q ? -by_difference : 0.0f;
    gradient[at] = fused(by_similarity, similarity, sign);
}
