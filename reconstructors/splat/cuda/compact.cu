// A thread a Gaussian: those that touch a tile are numbered on. `slots` counts them up to and with each.

extern "C" __global__ void __launch_bounds__(kThreads)
    compact(int count, const int* tiles, const int* slots, const float* depths, long long* ids, float* drawn_depths) {
    const int i = blockIdx.x * kThreads + threadIdx.x;
    if (i >= count || tiles[i] == 0) return;
    ids[slots[i] - 1] = i;
    drawn_depths[slots[i] - 1] = depths[i];
}
