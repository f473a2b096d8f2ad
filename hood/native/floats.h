// As many float32 numbers at a time as a register of the processor holds.
#pragma once
#include <cstdint>
#include <cstring>

#if defined(__AVX__)
#include <immintrin.h>
#endif

namespace {

#if defined(__AVX512F__)
constexpr int LANES = 16, SUMS = 24;  // numbers in a vector, and sums that are in registers at a time
#elif defined(__AVX__)
constexpr int LANES = 8, SUMS = 12;
#elif defined(__aarch64__)
constexpr int LANES = 4, SUMS = 24;
#else
constexpr int LANES = 4, SUMS = 12;
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
