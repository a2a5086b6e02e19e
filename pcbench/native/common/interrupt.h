// Ctrl-C during long loops. The calling thread polls Python at intervals, the other threads read a flag.
#pragma once
#include <atomic>
#include <chrono>

namespace pcbench {

class Interrupt {
public:
    // `poll` returns true if the work should stop. It is called only on the thread that created this object.
    explicit Interrupt(bool (*poll)());

    // Not inline: there must be one copy for all instruction sets.
    bool requested();  // cheap enough to be called every few microseconds
    bool stopped() const;

private:
    bool (*poll_)();
    std::chrono::steady_clock::time_point last_;
    std::atomic<bool> stop_{false};
};

}  // namespace pcbench
