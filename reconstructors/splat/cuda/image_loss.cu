// The structural similarity and the absolute difference of two images, one block per tile of one channel: their sums
// over the block, and for each pixel the gradient of the similarity with respect to the windowed x, x^2 and x y.

extern "C" __global__ void __launch_bounds__(kThreads)
    image_loss(int width, int height, const float* image, const float* target, float* grad_mean, float* grad_square,
               float* grad_product, float* sums) {
    __shared__ Surroundings<2> padded;
    __shared__ Across<4> across;
    __shared__ float totals[2][kThreads];
    const ChannelTile area = channel_tile(width);
    const int thread = threadIdx.x, x = thread % kTile, y = thread / kTile;
    for (int n = thread; n < kPadded * kPadded; n += kThreads) {
        const int column = area.left + n % kPadded - kRadius, row = area.top + n / kPadded - kRadius;
        const bool inside = 0 <= column && column < width && 0 <= row && row < height;
        const long long at = 3 * (static_cast<long long>(row) * width + column) + area.channel;
        padded.values[0][n / kPadded][n % kPadded] = inside ? image[at] : 0.0f;
        padded.values[1][n / kPadded][n % kPadded] = inside ? target[at] : 0.0f;
    }
    __syncthreads();
    for (int n = thread; n < kPadded * kTile; n += kThreads) {
        const int column = n % kTile, row = n / kTile;
        float a = 0.0f, b = 0.0f, squares = 0.0f, products = 0.0f;
        for (int k = -kRadius; k <= kRadius; ++k) {
            const float p = padded.values[0][row][column + kRadius + k],
                        q = padded.values[1][row][column + kRadius + k];
            const float wp = window_at(k) * p, wq = window_at(k) * q;
            a = a + wp, b = b + wq;
            squares = fused(wp, p, fused(wq, q, squares));
            products = fused(wp, q, products);
        }
        across.sums[0][row][column] = a, across.sums[1][row][column] = b;
        across.sums[2][row][column] = squares, across.sums[3][row][column] = products;
    }
    __syncthreads();

    float difference = 0.0f, similarity = 0.0f;
    if (area.left + x < width && area.top + y < height) {
        float means[4];
        down(across, x, y, means);
        const float mx = means[0], my = means[1], mxy = mx * my, mm = fused(mx, mx, my * my);
        const float a1 = fused(2.0f, mxy, kC1), a2 = fused(2.0f, means[3] - mxy, kC2);
        const float b1 = mm + kC1, b2 = (means[2] - mm) + kC2;
        const float inverse = 1.0f / (b1 * b2), slope = a1 * a2 * inverse / b2, product = 2.0f * a1 * inverse;
        similarity = a1 * a2 * inverse;
        const float p = padded.values[0][y + kRadius][x + kRadius], q = padded.values[1][y + kRadius][x + kRadius];
        difference = fabsf(p - q);
        const long long at = 3 * (static_cast<long long>(area.top + y) * width + area.left + x) + area.channel;
        grad_product[at] = product;
        grad_square[at] = -slope;
        grad_mean[at] = 2.0f * (my * a2 * inverse - mx * similarity / b1) - (my * product - 2.0f * mx * slope);
    }
    totals[0][thread] = difference, totals[1][thread] = similarity;
    for (int half = kThreads / 2; half > 0; half /= 2) {
        __syncthreads();
        if (thread < half) {
            totals[0][thread] = totals[0][thread] + totals[0][thread + half];
            totals[1][thread] = totals[1][thread] + totals[1][thread + half];
        }
    }
    if (thread == 0) sums[2 * blockIdx.x] = totals[0][0], sums[2 * blockIdx.x + 1] = totals[1][0];
}
