// Writes an instance for each tile that a drawn Gaussian touches, one thread per Gaussian, nearest first. The instances
// of a Gaussian start at begins[rank], which is also written to `firsts`. `order` has indices into the compacted
// Gaussians.

extern "C" __global__ void __launch_bounds__(kThreads)
    instances(const Pinhole* camera, int count, const long long* order, const long long* begins, const long long* ids,
              const Stored* splats, const Box* boxes, int* firsts, int* tiles, int* gaussians) {
    __shared__ int shared_ids[kThreads], shared_firsts[kThreads];
    const Pinhole at = *camera;
    const int thread = threadIdx.x, rank = blockIdx.x * kThreads + thread;
    const bool any = rank < count;
    Stored s = {};
    Box box = {};
    if (any) {
        const int id = static_cast<int>(ids[order[rank]]), first = static_cast<int>(begins[rank]);
        s = splats[id];
        box = boxes[id];
        shared_ids[thread] = id;
        shared_firsts[thread] = first;
        firsts[order[rank]] = first;
    }
    __syncwarp();
    for_each_tile(at, s, box, any, [&](int owner, int n, int tile) {
        const int of_owner = thread - thread % kLanes + owner, to = shared_firsts[of_owner] + n;
        tiles[to] = tile;
        gaussians[to] = shared_ids[of_owner];
    });
}
