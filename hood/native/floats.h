// As many float32 numbers at a time as a register of the processor holds.
#pragma once
#include <cstdint>
#include <cstring>

#include "registers.h"

#if defined(__AVX__)
#include <immintrin.h>
#endif

namespace {

constexpr int LANES = REGISTER / 4;  // numbers in a vector
#if defined(__AVX512F__) || defined(__aarch64__)
constexpr int SUMS = 24;  // that are in registers at a time
#else
constexpr int SUMS = 12;
#endif

typedef float V __attribute__((vector_size(4 * LANES)));

inline V load(const float* p) {
    V v;
    std::memcpy(&v, p, sizeof v);
    return v;
}
inline void store(float* p, V v) { std::memcpy(p, &v, sizeof v); }
inline V all(float x) { return V{} + x; }
inline V relu(V v) { return v < 0.0f ? V{} : v; }  // keeps a NaN
inline float total(V v) {
#if defined(__AVX512F__)
    return _mm512_reduce_add_ps((__m512)v);  // in the order of below
#else
    float half[LANES];
    store(half, v);
    for (int width = LANES / 2; width > 0; width /= 2)
        for (int i = 0; i < width; ++i) half[i] += half[i + width];
    return half[0];
#endif
}

}  // namespace
