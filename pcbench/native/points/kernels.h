// The loops that are compiled once per instruction set, and the choice between them.
#pragma once
#include "common/interrupt.h"
#include "pairs/monomials.h"
#include "points/tree.h"

namespace pcbench {

// Whether another point than a query's match has a squared distance below the match's plus `slack`.
struct Ties {
    double slack = 0.0;
    bool* flags = nullptr;  // null if not requested
};

// What earlier searches of moving queries have found. While the distance of the match, plus the distance that the query
// has moved, is less than the clearance, no other point can be nearer.
struct Track {
    double* places;      // (count, 3) position of each query at its last search
    int64_t* indices;    // its match
    double* clearances;  // the distance of the second nearest point; 0: not searched yet
};

constexpr size_t kMostLimits = 8;

struct Kernels {
    const char* name;
    bool (*sort_into_leaves)(const double* points, size_t count, double limit, Leaf* leaves, Node* nodes, Interrupt&);
    void (*build_upper_levels)(Tree&);
    void (*nearest)(const Tree&, const Leaf* queries, size_t leaf_count, const int64_t* hints, bool own_leaves,
                    double* distances, int64_t* indices, Ties, Interrupt&);
    void (*follow)(const Tree&, const Leaf* queries, size_t leaf_count, const Track&, double* distances, Interrupt&);
    // Each thread has its own scratch memory of knearest_scratch_bytes(k).
    void (*knearest)(const Tree&, const Leaf* queries, size_t leaf_count, size_t k, double* distances, int64_t* indices,
                     double* const* scratch, Interrupt&);
    size_t (*knearest_scratch_bytes)(size_t k);
    // If `rows` is null, both functions write the number of points found for query i to offsets[i + 1]. Otherwise they
    // write the rows of these points, from rows[offsets[i]] on, in no particular order.
    void (*in_balls)(const Tree&, const Leaf* centres, size_t leaf_count, double radius, int64_t* offsets,
                     int64_t* rows, Interrupt&);
    void (*in_cylinders)(const Tree&, const Leaf* origins, size_t leaf_count, const double* axes, double radius,
                         double half_length, int64_t* offsets, int64_t* rows, Interrupt&);
    // `limits` and `counts` have `limit_count` <= kMostLimits columns: distances from each query, and the numbers of
    // points within them.
    void (*count_near)(const Tree&, const Leaf* queries, size_t leaf_count, const double* limits, size_t limit_count,
                       int64_t* counts, Interrupt&);
    // Queries are points of the tree; `rows` holds their indices, null for all in order. Each thread has its own
    // scratch memory of plane_scratch_bytes(k). `distances` and `indices` are those of the nearest other point, and
    // `reach` is the distance of the k-th nearest point, the query included.
    void (*planes)(const Tree&, const Leaf* queries, size_t leaf_count, const int64_t* rows, size_t k, double* normals,
                   double* variation, double* distances, int64_t* indices, double* reach, double* const* scratch,
                   Interrupt&);
    size_t (*plane_scratch_bytes)(size_t k);
    void (*normal_equations)(size_t begin, size_t end, const double* positions, const double* normals,
                             const double* weights, const double* residuals, const MonomialStep* steps, double* moments,
                             double* scores);
    void (*whole_normal_equations)(size_t count, const double* positions, const double* normals,
                                   const double* residuals, const MonomialStep* steps, int64_t* moments,
                                   int64_t* scores);
};

namespace baseline {
extern const Kernels kernels;
}
#ifdef PCB_X86
namespace avx2 {
extern const Kernels kernels;
}
namespace avx512 {
extern const Kernels kernels;
}
#endif

// The widest supported instruction set, or the one named by PCBENCH_ISA; throws std::runtime_error if unsupported.
const Kernels& kernels();

}  // namespace pcbench
