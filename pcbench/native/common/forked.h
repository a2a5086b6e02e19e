// OpenMP loops in a process created by fork(), as Python's multiprocessing does on Linux.
#pragma once
#include <omp.h>
#ifndef _WIN32
#include <pthread.h>
#endif

namespace pcbench {

// A forked child has none of its parent's threads, but OpenMP would wait for them forever. The child therefore uses one
// thread. Every module calls this function when it is imported; results do not depend on the number of threads.
inline void one_thread_when_forked() {
#ifndef _WIN32  // which has no fork()
    pthread_atfork(nullptr, nullptr, [] { omp_set_num_threads(1); });
#endif
}

}  // namespace pcbench
