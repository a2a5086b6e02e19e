// Compacts the Gaussians that touch a tile, one thread per Gaussian. `slots` numbers them from 1.

extern "C" __global__ void __launch_bounds__(kThreads)
    compact(int count, const int* tiles, const int* slots, const float* depths, long long* ids, float* drawn_depths) {
    const int i = blockIdx.x * kThreads + threadIdx.x;
    if (i >= count || tiles[i] == 0) return;
    ids[slots[i] - 1] = i;
    drawn_depths[slots[i] - 1] = depths[i];
}
