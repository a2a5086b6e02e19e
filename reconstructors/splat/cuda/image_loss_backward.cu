// The gradient of the loss with respect to the image: the window is its own adjoint. `grad_similarity` and
// `grad_difference` are the gradients with respect to one pixel's similarity and absolute difference.

extern "C" __global__ void __launch_bounds__(kThreads)
    image_loss_backward(int width, int height, float grad_similarity, float grad_difference, const float* image,
                        const float* target, const float* grad_mean, const float* grad_square,
                        const float* grad_product, float* gradient) {
    __shared__ Surroundings<3> padded;
    __shared__ Across<3> across;
    const ChannelTile area = channel_tile(width);
    const int thread = threadIdx.x, x = thread % kTile, y = thread / kTile;
    for (int n = thread; n < kPadded * kPadded; n += kThreads) {
        const int column = area.left + n % kPadded - kRadius, row = area.top + n / kPadded - kRadius;
        const bool inside = 0 <= column && column < width && 0 <= row && row < height;
        const long long at = 3 * (static_cast<long long>(row) * width + column) + area.channel;
        padded.values[0][n / kPadded][n % kPadded] = inside ? grad_mean[at] : 0.0f;
        padded.values[1][n / kPadded][n % kPadded] = inside ? grad_square[at] : 0.0f;
        padded.values[2][n / kPadded][n % kPadded] = inside ? grad_product[at] : 0.0f;
    }
    __syncthreads();
    for (int n = thread; n < 3 * kPadded * kTile; n += kThreads) {
        const int map = n / (kPadded * kTile), row = n / kTile % kPadded, column = n % kTile;
        float sum = 0.0f;
        for (int k = -kRadius; k <= kRadius; ++k)
            sum = fused(window_at(k), padded.values[map][row][column + kRadius + k], sum);
        across.sums[map][row][column] = sum;
    }
    __syncthreads();
    if (area.left + x >= width || area.top + y >= height) return;
    float sums[3];
    down(across, x, y, sums);
    const long long at = 3 * (static_cast<long long>(area.top + y) * width + area.left + x) + area.channel;
    const float p = image[at], q = target[at];
    const float similarity = fused(2.0f * p, sums[1], fused(q, sums[2], sums[0]));
    const float sign = q < p ? grad_difference : p < q ? -grad_difference : 0.0f;
    gradient[at] = fused(grad_similarity, similarity, sign);
}
