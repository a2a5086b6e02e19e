// Adam (Kingma and Ba 2015) on the rows that have a gradient, one thread per value; row i of `gradient` belongs to row
// ids[i] of the other arrays. `rates`, one per column, and `epsilon` include the bias corrections: rate
// sqrt(1 - beta2^t) / (1 - beta1^t), epsilon sqrt(1 - beta2^t). `rest` is 1 - beta.

extern "C" __global__ void __launch_bounds__(kThreads)
    adam(long long count, int columns, float* parameters, float* first, float* second, const float* gradient,
         const long long* ids, const float* rates, float epsilon, float beta1, float beta2, float rest1, float rest2) {
    const long long i = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
    if (i >= count) return;
    const long long column = i % columns, at = ids[i / columns] * columns + column;
    const float g = gradient[i];
    const float mean = fused(beta1, first[at], rest1 * g), square = fused(beta2, second[at], rest2 * g * g);
    first[at] = mean;
    second[at] = square;
    parameters[at] = fused(-rates[column], mean / (root(square) + epsilon), parameters[at]);
}
