// Requests to callgrind, for benchmarks/instructions.py. Without valgrind they do nothing.

#include <valgrind/callgrind.h>

extern "C" void start_counting() { CALLGRIND_START_INSTRUMENTATION; }

// Write the counts since the last call to a file that contains the label, and begin at zero.
extern "C" void write_counts(const char* label) { CALLGRIND_DUMP_STATS_AT(label); }

extern "C" void stop_counting() { CALLGRIND_STOP_INSTRUMENTATION; }
