// Ctrl-C during long loops: the calling thread asks Python now and then, the others look at a flag.
#pragma once
#include <atomic>
#include <chrono>

namespace pcbench {

class Interrupt {
public:
    // `asks` returns true when the work shall stop; it is only ever called on the thread that made this object.
    explicit Interrupt(bool (*asks)());

    // Neither is inline: they must exist once, for all instruction sets.
    bool requested();  // cheap enough for every few microseconds of work
    bool stopped() const;

private:
    bool (*asks_)();
    std::chrono::steady_clock::time_point last_;
    std::atomic<bool> stop_{false};
};

}  // namespace pcbench
