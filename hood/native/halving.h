// Faces in an order in which neighbours lie together, by halving.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

namespace {

// Puts the items ``begin`` to ``end`` of an order with the lower centres (., 3) along their longest side before ``middle``.
inline void halve(int32_t* order, int32_t begin, int32_t middle, int32_t end, const double* centre) {
    double low[3] = {INFINITY, INFINITY, INFINITY}, high[3] = {-INFINITY, -INFINITY, -INFINITY};
    for (int32_t i = begin; i < end; ++i)
        for (int k = 0; k < 3; ++k) {
            const double value = centre[3 * (int64_t)order[i] + k];
            low[k] = std::min(low[k], value), high[k] = std::max(high[k], value);
        }
    int axis = 0;
    for (int k = 1; k < 3; ++k)
        if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
    std::nth_element(order + begin, order + middle, order + end, [&](int32_t a, int32_t b) {
        const double x = centre[3 * (int64_t)a + axis], y = centre[3 * (int64_t)b + axis];
        return x < y || (x == y && a < b);
    });
}

// Orders the items 0 to ``count``, in leaves of so many, that groups of eight leaves, and of eight of these, lie together: the first
// half is full on all levels.
inline void order_leaves(int32_t* order, int32_t count, int32_t wide, const double* centre) {
    struct {
        int32_t begin, end;
    } left[64];
    int size = 0;
    left[size++] = {0, count};
    while (size) {
        const auto now = left[--size];
        const int32_t leaves = (now.end - now.begin + wide - 1) / wide;
        if (leaves <= 1) continue;
        int32_t part = 1;
        while (2 * part < leaves) part *= 2;
        const int32_t middle = now.begin + wide * part;
        halve(order, now.begin, middle, now.end, centre);
        left[size++] = {now.begin, middle}, left[size++] = {middle, now.end};
    }
}

}  // namespace
