// The structural similarity and the absolute difference of two images, a block a tile of one channel: their sums over
// the block, and for each pixel the similarity's derivative by what the window gives of x, of x^2 and of x y.

extern "C" __global__ void __launch_bounds__(kThreads)
    image_loss(int width, int height, const float* image, const float* target, float* by_mean, float* by_square,
               float* by_product, float* sums) {
    __shared__ Surroundings<2> near;
    __shared__ Across<4> across;
    __shared__ float totals[2][kThreads];
    const Place place = place_of(width);
    const int thread = threadIdx.x, x = thread % kTile, y = thread / kTile;
    for (int n = thread; n < kWide * kWide; n += kThreads) {
        const int column = place.left + n % kWide - kReach, row = place.top + n / kWide - kReach;
        const bool inside = 0 <= column && column < width && 0 <= row && row < height;
        const long long at = 3 * (static_cast<long long>(row) * width + column) + place.channel;
        near.values[0][n / kWide][n % kWide] = inside ? image[at] : 0.0f;
        near.values[1][n / kWide][n % kWide] = inside ? target[at] : 0.0f;
    }
    __syncthreads();
    for (int n = thread; n < kWide * kTile; n += kThreads) {
        const int column = n % kTile, row = n / kTile;
        float a = 0.0f, b = 0.0f, squares = 0.0f, products = 0.0f;
        for (int k = -kReach; k <= kReach; ++k) {
            const float p = near.values[0][row][column + kReach + k], q = near.values[1][row][column + kReach + k];
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
    if (place.left + x < width && place.top + y < height) {
        float means[4];
        down(across, x, y, means);
        const float mx = means[0], my = means[1], mxy = mx * my, mm = fused(mx, mx, my * my);
        const float a1 = fused(2.0f, mxy, kC1), a2 = fused(2.0f, means[3] - mxy, kC2);
        const float b1 = mm + kC1, b2 = (means[2] - mm) + kC2;
        const float below = 1.0f / (b1 * b2), slope = a1 * a2 * below / b2, product = 2.0f * a1 * below;
        similarity = a1 * a2 * below;
        const float p = near.values[0][y + kReach][x + kReach], q = near.values[1][y + kReach][x + kReach];
        difference = fabsf(p - q);
        const long long at = 3 * (static_cast<long long>(place.top + y) * width + place.left + x) + place.channel;
        by_product[at] = product;
        by_square[at] = -slope;
        by_mean[at] = 2.0f * (my * a2 * below - mx * similarity / b1) - (my * product - 2.0f * mx * slope);
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
