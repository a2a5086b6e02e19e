// Loops in a process that fork() made, as Python's multiprocessing does on Linux.
#pragma once
#include <omp.h>
#ifndef _WIN32
#include <pthread.h>
#endif

namespace pcbench {

// Such a child has none of its parent's threads, but OpenMP believes that they are there and would wait for them for
// ever: what is forked works with one thread. Each module says this when it is imported; results do not depend on it.
inline void one_thread_when_forked() {
#ifndef _WIN32  // which has no fork()
    pthread_atfork(nullptr, nullptr, [] { omp_set_num_threads(1); });
#endif
}

}  // namespace pcbench
