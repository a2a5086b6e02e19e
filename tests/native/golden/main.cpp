// Runs every kernel on small inputs and prints a hash of each result; see test_golden.py.
#include "golden.h"

int main() {
    golden::points();
    golden::mesh();
    golden::pairs();
    golden::patchmatch();
    golden::splats();
}
