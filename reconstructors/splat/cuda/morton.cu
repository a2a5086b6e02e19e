// The Morton code of a point (Morton 1966), 21 bits per axis, one thread per point. `box` is the lower corner and the
// number of cells per unit, the same along each axis.

__device__ inline long long spread(unsigned value) {
    unsigned long long x = value;  // two zeros are inserted between neighbouring bits
    x = (x | x << 32) & 0x001f00000000ffffULL;
    x = (x | x << 16) & 0x001f0000ff0000ffULL;
    x = (x | x << 8) & 0x100f00f00f00f00fULL;
    x = (x | x << 4) & 0x10c30c30c30c30c3ULL;
    x = (x | x << 2) & 0x1249249249249249ULL;
    return static_cast<long long>(x);
}

extern "C" __global__ void __launch_bounds__(kThreads)
    morton(int count, const float* points, const float* box, long long* codes) {
    const int i = blockIdx.x * kThreads + threadIdx.x;
    if (i >= count) return;
    long long code = 0;
    for (int axis = 0; axis < 3; ++axis) {
        const float cell = (points[3LL * i + axis] - box[axis]) * box[3];
        // NaN becomes 0.
        const unsigned clamped = 0.0f < cell ? static_cast<unsigned>(lesser(cell, 2097151.0f)) : 0u;
        code |= spread(clamped) << axis;
    }
    codes[i] = code;
}
