// Runs a CUDA kernel on the CPU, from the same source as the compiler of a GPU: each thread of a block is a fiber, and
// the blocks run one after the other. Barriers and warp operations yield control until all participants have arrived.
// Threads and blocks run forwards, backwards or in a new random order each time: if a result depends on the order, a
// barrier is missing. Undefined behaviour ends the launch with a message: threads of a block at different barriers, or
// a lane that other lanes wait for and that has ended or executes another operation.
//
// It emulates neither the memory model nor lanes in lockstep, registers or speed.
#pragma once

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "fibers.h"

#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/asan_interface.h>
#include <sanitizer/common_interface_defs.h>
#endif

struct dim3 {
    unsigned x = 1, y = 1, z = 1;
};
static dim3 threadIdx, blockIdx, blockDim, gridDim;

namespace emulator {

constexpr unsigned kWarpSize = 32;
constexpr unsigned kMaxThreads = 1024;  // per block

// ---- threads

enum class State { kReady, kAtBlock, kAtWarp, kEnded };
enum class WarpOperation { kSync, kShuffle, kBallot, kAdd, kMatch };

struct Thread {
    Context context;
    char* stack = nullptr;
    void* fake_stack = nullptr;
    State state = State::kReady;
    int line = 0;  // of the barrier or warp operation at which it waits
    // The warp operation: its arguments and its result.
    WarpOperation kind = WarpOperation::kSync;
    unsigned mask = 0, source = 0;
    uint64_t value = 0, result = 0;
};

struct Machine {
    Thread threads[kMaxThreads];
    unsigned count = 0;  // of threads
    Context scheduler;
    void* fake_stack = nullptr;
    const void* bottom = nullptr;  // of the scheduler's stack
    size_t size = 0;
    unsigned running = 0;
    void (*call)() = nullptr;
    char* message = nullptr;
    size_t room = 0;
    bool failed = false;
};
static Machine machine;

template <class... Parts>
void fail(const char* format, Parts... parts) {
    if (!machine.failed) {
        const int length = std::snprintf(machine.message, machine.room, "block %u: ", blockIdx.x);
        std::snprintf(machine.message + length, machine.room - static_cast<size_t>(length), format, parts...);
    }
    machine.failed = true;
}

inline void to_scheduler(bool ended) {
    Thread& thread = machine.threads[machine.running];
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_start_switch_fiber(ended ? nullptr : &thread.fake_stack, machine.bottom, machine.size);
#endif
    (void)ended;
    switch_context(thread.context, machine.scheduler);
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_finish_switch_fiber(thread.fake_stack, &machine.bottom, &machine.size);
#endif
}

inline void run_thread() {
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_finish_switch_fiber(nullptr, &machine.bottom, &machine.size);
#endif
    machine.call();
    machine.threads[machine.running].state = State::kEnded;
    to_scheduler(true);
    std::abort();
}

inline void resume(unsigned number) {
    Thread& thread = machine.threads[number];
    machine.running = number;
    threadIdx.x = number;
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_start_switch_fiber(&machine.fake_stack, thread.stack, kStackBytes);
#endif
    switch_context(machine.scheduler, thread.context);
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_finish_switch_fiber(machine.fake_stack, nullptr, nullptr);
#endif
}

// ---- barriers

inline uint64_t block_barrier(uint64_t value, int line) {
    Thread& thread = machine.threads[machine.running];
    thread.state = State::kAtBlock;
    thread.line = line;
    thread.value = value;
    to_scheduler(false);
    return thread.result;
}

inline uint64_t warp_operation(WarpOperation kind, unsigned mask, uint64_t value, unsigned source, int line) {
    Thread& thread = machine.threads[machine.running];
    const unsigned lane = machine.running % kWarpSize;
    if ((mask >> lane & 1u) == 0)
        fail("thread %u is not in the mask %08x that it names (line %d)", machine.running, mask, line);
    thread.state = State::kAtWarp;
    thread.line = line;
    thread.kind = kind;
    thread.mask = mask;
    thread.value = value;
    thread.source = source;
    to_scheduler(false);
    return thread.result;
}

// Resumes a warp if all lanes that take part in the operation of thread `number` have arrived.
inline void release_warp(unsigned number) {
    const Thread& caller = machine.threads[number];
    if (caller.state != State::kAtWarp) return;
    const unsigned first = number - number % kWarpSize;
    Thread* lanes = &machine.threads[first];
    const unsigned count = machine.count - first < kWarpSize ? machine.count - first : kWarpSize;
    unsigned ballot = 0;
    uint64_t sum = 0;
    for (unsigned lane = 0; lane < count; ++lane) {
        if ((caller.mask >> lane & 1u) == 0) continue;
        const Thread& other = lanes[lane];
        if (other.state == State::kEnded)
            return fail("thread %u waits for lane %u of its warp, which has ended (line %d)", number, lane,
                        caller.line);
        if (other.state != State::kAtWarp) return;
        if (other.mask != caller.mask || other.kind != caller.kind || other.line != caller.line)
            return fail("divergent warp: thread %u is at line %d with mask %08x, thread %u at line %d with mask %08x",
                        number, caller.line, caller.mask, first + lane, other.line, other.mask);
        if (other.value != 0) ballot |= 1u << lane;
        sum += other.value;
    }
    for (unsigned lane = 0; lane < count; ++lane) {
        if ((caller.mask >> lane & 1u) == 0) continue;
        Thread& mine = lanes[lane];
        if (mine.kind == WarpOperation::kShuffle) {
            const unsigned source =
                mine.source < count && (mine.mask >> mine.source & 1u) != 0 ? mine.source : kWarpSize;
            if (source == kWarpSize)
                return fail("thread %u reads a lane that takes no part (line %d)", first + lane, mine.line);
            mine.result = lanes[source].value;
        } else if (mine.kind == WarpOperation::kBallot) {
            mine.result = ballot;
        } else if (mine.kind == WarpOperation::kAdd) {
            mine.result = sum;
        } else if (mine.kind == WarpOperation::kMatch) {
            mine.result = 0;
            for (unsigned other = 0; other < count; ++other)
                if ((mine.mask >> other & 1u) != 0 && lanes[other].value == mine.value) mine.result |= 1u << other;
        }
    }
    for (unsigned lane = 0; lane < count; ++lane)
        if ((caller.mask >> lane & 1u) != 0) lanes[lane].state = State::kReady;
}

// Resumes a block if all of its threads have arrived at one barrier.
inline void release_block() {
    const Thread& first = machine.threads[0];
    uint64_t count = 0;
    for (unsigned i = 0; i < machine.count; ++i) {
        if (machine.threads[i].state != State::kAtBlock) return;
        count += machine.threads[i].value;
    }
    for (unsigned i = 0; i < machine.count; ++i)
        if (machine.threads[i].line != first.line)
            return fail("divergent barrier: thread 0 is at line %d, thread %u at line %d", first.line, i,
                        machine.threads[i].line);
    for (unsigned i = 0; i < machine.count; ++i)
        machine.threads[i].result = count, machine.threads[i].state = State::kReady;
}

// Reports a deadlock: two threads and where each of them waits.
inline void fail_stuck() {
    unsigned waiting = 0, other = 0;
    const auto& threads = machine.threads;
    while (threads[waiting].state == State::kEnded) ++waiting;
    while (other < machine.count && threads[other].state == threads[waiting].state) ++other;
    const char* names[] = {"ready", "at a barrier of the block", "at a barrier of its warp", "ended"};
    if (other == machine.count)
        return fail("divergent barrier: thread %u waits (line %d)", waiting, threads[waiting].line);
    fail("divergent barrier: thread %u is %s (line %d), thread %u %s (line %d)", waiting,
         names[static_cast<int>(threads[waiting].state)], threads[waiting].line, other,
         names[static_cast<int>(threads[other].state)], threads[other].line);
}

// ---- orders

enum Order { kForward = 0, kReverse = 1, kRandom = 2 };

struct Shuffler {
    int order;
    uint64_t seed;
    uint64_t draw() {  // splitmix64
        uint64_t z = seed += 0x9e3779b97f4a7c15ULL;
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
        z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
        return z ^ (z >> 31);
    }
    void shuffle(unsigned* numbers, unsigned count) {
        for (unsigned i = 0; i < count; ++i) numbers[i] = order == kReverse ? count - 1 - i : i;
        if (order != kRandom) return;
        for (unsigned i = count; i > 1; --i) {
            const unsigned other = static_cast<unsigned>(draw() % i), last = numbers[i - 1];
            numbers[i - 1] = numbers[other];
            numbers[other] = last;
        }
    }
};

// Shared memory is a static variable in its own section, which is overwritten before each block: floats become NaN,
// integers -1. Sanitizers need ordinary statics to guard their bounds.
#if !defined(__SANITIZE_ADDRESS__)
extern "C" char __start_emulated_shared[] __attribute__((weak, visibility("hidden")));
extern "C" char __stop_emulated_shared[] __attribute__((weak, visibility("hidden")));
inline void overwrite_shared() {
    if (__start_emulated_shared != nullptr)
        std::memset(__start_emulated_shared, 0xff,
                    static_cast<size_t>(__stop_emulated_shared - __start_emulated_shared));
}
#else
inline void overwrite_shared() {}
#endif

inline void run_block(Shuffler& shuffler) {
    overwrite_shared();
    Thread* threads = machine.threads;
    for (unsigned i = 0; i < machine.count; ++i) {
        threads[i].state = State::kReady;
        make_context(threads[i].context, threads[i].stack, run_thread);
    }
    unsigned numbers[kMaxThreads];
    for (bool moved = true; moved && !machine.failed;) {
        moved = false;
        shuffler.shuffle(numbers, machine.count);
        for (unsigned i = 0; i < machine.count; ++i) {
            const unsigned number = numbers[i];
            if (threads[number].state != State::kReady) continue;
            resume(number);
            moved = true;
            if (!machine.failed) release_warp(number);
            if (machine.failed) return;
            if (threads[number].state == State::kAtBlock) release_block();
        }
    }
    for (unsigned i = 0; i < machine.count; ++i)
        if (threads[i].state != State::kEnded) return fail_stuck();
}

inline int run(void (*call)(), unsigned blocks, unsigned threads, int order, uint64_t seed, char* message,
               size_t room) {
    if (threads > kMaxThreads) std::abort();
    char* stacks = static_cast<char*>(std::malloc(kStackBytes * threads));
    unsigned* numbers = static_cast<unsigned*>(std::malloc(sizeof(unsigned) * blocks));
    for (unsigned i = 0; i < threads; ++i) machine.threads[i].stack = stacks + kStackBytes * i;
    machine.count = threads;
    machine.call = call;
    machine.message = message;
    machine.room = room;
    machine.failed = false;
    gridDim.x = blocks, blockDim.x = threads;
    Shuffler shuffler{order, seed};
    shuffler.shuffle(numbers, blocks);
    for (unsigned i = 0; i < blocks && !machine.failed; ++i) {
        blockIdx.x = numbers[i];
        run_block(shuffler);
    }
    std::free(numbers);
    std::free(stacks);
    return machine.failed ? 1 : 0;
}

}  // namespace emulator
