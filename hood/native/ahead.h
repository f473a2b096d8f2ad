// Memory that is needed soon, brought into second-level cache line by line between the products of a tile of rows. A core asks
// memory for few lines at a time; asked for at once they would hold up the products, asked for when needed they do.
#pragma once
#include <cstdint>

namespace {

class Ahead {
    static constexpr int LINE = 64, MOST = 256;
    struct Span {
        const char *at, *end;
    };
    Span spans[MOST];
    int count = 0, next = 0;
    const char *at = nullptr, *end = nullptr;

  public:
    void clear() {
        count = next = 0;
        at = end = nullptr;
    }
    // what comes after the spans before; null and what is too much are left out
    void add(const void* from, int64_t bytes) {
        if (from && bytes > 0 && count < MOST) spans[count++] = {(const char*)from, (const char*)from + bytes};
    }
    // ask for the next lines
    inline void turn(int lines = 1) {
        for (; lines > 0; --lines, at += LINE) {
            if (at >= end) {
                if (next == count) return;
                at = spans[next].at, end = spans[next].end;
                ++next;
            }
            __builtin_prefetch(at, 0, 2);
        }
    }
};

}  // namespace
