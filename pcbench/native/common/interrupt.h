// Ctrl-C during long loops: the calling thread asks Python now and then, the others look at a flag.
#pragma once
#include <atomic>
#include <chrono>

namespace pcbench {

class Interrupt {
public:
    // `asks` returns true when the work shall stop; it is only ever called on the thread that made this object.
    explicit Interrupt(bool (*asks)());

    // Cheap enough for every few microseconds of work. Not inline: it must exist once, for all instruction sets.
    bool requested();
    bool stopped() const { return stop_.load(std::memory_order_relaxed); }

private:
    bool (*asks_)();
    std::chrono::steady_clock::time_point last_;
    std::atomic<bool> stop_{false};
};

}  // namespace pcbench
