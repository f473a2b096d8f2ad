// One network block over rows, tile by tile, in registers and first-level cache: first layer (of an edge network), second and
// third layer, layer norm, residual and the sums at the receivers; forward and backward. Built by hood/model/kernels/block.py with
// WIDTH, a multiple of 16, PANEL, 16 to 64 columns that divide it, and HALF, 1 for bfloat16 and 0 for float32. bfloat16 needs
// AVX-512. Where the compiler is told of AMX, its products with widths of a multiple of 32 are by tiles.
#include <cstdint>
#include <cstring>
#include <initializer_list>

#include "ahead.h"
#include "floats.h"

#if HALF && defined(__AMX_BF16__) && WIDTH % 32 == 0
#define TILES 1
#include <sys/syscall.h>
#include <unistd.h>
#else
#define TILES 0
#endif

namespace {

constexpr int D = WIDTH;
constexpr int VECTORS = D / LANES;
constexpr int TILE = 96;          // rows: a tile's arrays stay in second-level cache, a panel of weights is used again
constexpr int P = PANEL / LANES;  // vectors of a panel's columns
constexpr int GROUP = SUMS / P;   // rows whose sums are in registers at a time
constexpr int FOURS = GROUP < 4 ? GROUP : GROUP / 4 * 4;
constexpr int GRAM_ROWS = D % GROUP == 0 ? GROUP : FOURS < D ? FOURS : D;  // for gradients of weights; a rest of two rows is slow
constexpr int AHEAD = 1536 / LANES;  // products of vectors between two lines that are asked for

// ---- the precision of latents and factors; everything else is float32 ----------------------------------------------------

#if HALF
using T = uint16_t;
using Word = uint32_t __attribute__((may_alias));
using Factors = __m512i;
inline V load(const T* p) {
    return (V)_mm512_slli_epi32(_mm512_cvtepu16_epi32(_mm256_loadu_si256((const __m256i*)p)), 16);
}
inline void store(T* p, V v) { _mm256_storeu_si256((__m256i*)p, (__m256i)_mm512_cvtneps_pbh((__m512)v)); }
inline void stream(T* p, V v) { _mm256_stream_si256((__m256i*)p, (__m256i)_mm512_cvtneps_pbh((__m512)v)); }
inline Factors factors(const Word* p) { return _mm512_loadu_si512(p); }
inline V multiply(V sum, Word a, Factors b) {
    return (V)_mm512_dpbf16_ps((__m512)sum, (__m512bh)_mm512_set1_epi32((int)a), (__m512bh)b);
}
#else
using T = float;
using Word = float;
using Factors = V;
inline void stream(T* p, V v) {
#if defined(__AVX512F__)
    _mm512_stream_ps(p, (__m512)v);
#elif defined(__AVX__)
    _mm256_stream_ps(p, (__m256)v);
#else
    store(p, v);
#endif
}
inline Factors factors(const Word* p) { return load(p); }
inline V multiply(V sum, Word a, Factors b) { return sum + a * b; }
#endif
constexpr int PER_WORD = 4 / sizeof(T);  // factors in 32 bits: a product adds that many terms at once
constexpr int WORDS = D / PER_WORD;

// ---- memory --------------------------------------------------------------------------------------------------------------

// What is written to memory past the caches, line by line between the products: it is read again in another pass, and a line
// that goes through the caches is first read.
class Behind {
    static constexpr int MOST = 4;  // arrays of a tile
    struct Span {
        const char* from;
        char* to;
        int64_t bytes;
    };
    Span spans[MOST];
    int count = 0, next = 0;
    int64_t at = 0;  // of the next span

    static inline void half_a_line(const char* from, char* to) {
#if defined(__AVX__)
        _mm256_stream_si256((__m256i*)to, _mm256_loadu_si256((const __m256i*)from));
#else
        std::memcpy(to, from, 32);
#endif
    }

  public:
    void add(const void* from, void* to, int64_t bytes) { spans[count++] = {(const char*)from, (char*)to, bytes}; }
    inline void turn(int lines) {
        for (; lines > 0 && next < count; --lines) {
            const Span& span = spans[next];
            half_a_line(span.from + at, span.to + at);
            if (at + 32 < span.bytes) half_a_line(span.from + at + 32, span.to + at + 32);
            if ((at += 64) >= span.bytes) ++next, at = 0;
        }
    }
    void finish() {
        while (next < count) turn(1 << 20);
        count = next = 0;
    }
};

// waits until what was written past the caches is in memory
inline void flush_writes() {
#if defined(__AVX__)
    _mm_sfence();
#endif
}

struct Traffic {
    Ahead ahead;
    Behind behind;
    inline void turn(int lines = 1) {
        ahead.turn(lines);
        behind.turn(lines);
    }
};

// ---- products ------------------------------------------------------------------------------------------------------------

template <int R>
inline void accumulate_step(V (&sum)[R][P], const Word* a, int64_t a_row, const Word* b) {
    Factors column[P];
#pragma GCC unroll 4
    for (int j = 0; j < P; ++j) column[j] = factors(b + LANES * j);
#pragma GCC unroll 24
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 4
        for (int j = 0; j < P; ++j) sum[r][j] = multiply(sum[r][j], a[r * a_row], column[j]);
}

// sums over k of a[r * a_row + k * a_step] * b[k * b_step + …] for R rows and a panel of columns
template <int R>
inline void accumulate(V (&sum)[R][P], const Word* a, int64_t a_row, int64_t a_step, const Word* b, int64_t b_step, int steps,
                       Traffic& traffic) {
    constexpr int STEPS = AHEAD / (R * P);
    int k = 0;
    for (; k + STEPS <= steps; k += STEPS) {
        traffic.turn();
#pragma GCC unroll 1
        for (int i = k; i < k + STEPS; ++i) accumulate_step<R>(sum, a + i * a_step, a_row, b + i * b_step);
    }
    for (; k < steps; ++k) accumulate_step<R>(sum, a + k * a_step, a_row, b + k * b_step);
}

template <int R, class Emit>
inline void rows_product(const T* x, const T* weight, int row, int column, Traffic& traffic, const Emit& emit) {
    V sum[R][P];
#pragma GCC unroll 24
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 4
        for (int j = 0; j < P; ++j) sum[r][j] = V{};
    accumulate<R>(sum, (const Word*)(x + (int64_t)row * D), WORDS, 1, (const Word*)weight + (int64_t)column * WORDS, PANEL, WORDS,
                  traffic);
#pragma GCC unroll 24
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 4
        for (int j = 0; j < P; ++j) emit(row + r, column + LANES * j, sum[r][j]);
}

#if TILES

// Tiles 0 to 3 hold sums, (16, 16) float32 each; 4 and 5 rows of the left factor, 6 and 7 columns of the right one, in both of
// them 32 terms of the sums.
struct alignas(64) TileShapes {
    uint8_t palette = 1, start = 0, reserved[14] = {};
    uint16_t bytes[16] = {64, 64, 64, 64, 64, 64, 64, 64};
    uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, 16};
};

// what was written is in memory before tiles read it: to compilers they do not
inline void settle() { asm volatile("" ::: "memory"); }

struct Tiles {  // for the length of a call: other libraries give tiles their own shapes
    Tiles() {
        const TileShapes shapes;
        settle();
        _tile_loadconfig(&shapes);
    }
    ~Tiles() { _tile_release(); }
};

constexpr int LINES = 6;  // asked for at a time

// tiles 0 to 3 += (32, D) (D, 32) for D terms; strides in bytes from row to row, of the right factor from pair to pair of rows
inline void accumulate_tiles(const T* left, int64_t left_row, const Word* right, int64_t right_pair, int terms, Traffic& traffic) {
    settle();
    for (int k = 0; k < terms; k += 32) {
        traffic.turn(LINES);
        _tile_loadd(4, left + k, left_row);
        _tile_loadd(6, (const char*)right + k / 2 * right_pair, right_pair);
        _tile_loadd(7, (const char*)right + k / 2 * right_pair + 64, right_pair);
        _tile_dpbf16ps(0, 4, 6);
        _tile_loadd(5, (const char*)(left + k) + 16 * left_row, left_row);
        _tile_dpbf16ps(1, 4, 7);
        _tile_dpbf16ps(2, 5, 6);
        _tile_dpbf16ps(3, 5, 7);
    }
}

template <class Emit>
void product(const T* x, int rows, const T* weight, Traffic& traffic, const Emit& emit) {
    alignas(64) static thread_local T last[32 * D];
    alignas(64) float sum[32][32];
    for (int row = 0; row < rows; row += 32) {
        const T* left = x + (int64_t)row * D;
        const int present = rows - row < 32 ? rows - row : 32;
        if (present < 32) {
            memcpy(last, left, (size_t)present * D * sizeof(T));
            memset(last + present * D, 0, (size_t)(32 - present) * D * sizeof(T));
            left = last;
        }
        for (int column = 0; column < D; column += 32) {
            const Word* panel = (const Word*)weight + (int64_t)(column / PANEL) * PANEL * WORDS + column % PANEL;
            _tile_zero(0);
            _tile_zero(1);
            _tile_zero(2);
            _tile_zero(3);
            accumulate_tiles(left, D * sizeof(T), panel, PANEL * sizeof(Word), D, traffic);
            _tile_stored(0, sum[0], sizeof sum[0]);
            _tile_stored(1, sum[0] + 16, sizeof sum[0]);
            _tile_stored(2, sum[16], sizeof sum[0]);
            _tile_stored(3, sum[16] + 16, sizeof sum[0]);
            settle();
            for (int r = 0; r < present; ++r) {
                emit(row + r, column, load(sum[r]));
                emit(row + r, column + 16, load(sum[r] + 16));
            }
        }
    }
}

#else

struct Tiles {};

// emit(row, column, a vector) of x W for all rows of a tile; the weight lies in panels of columns
template <class Emit>
void product(const T* x, int rows, const T* weight, Traffic& traffic, const Emit& emit) {
    for (int column = 0; column < D; column += PANEL) {
        int row = 0;
        for (; row + GROUP <= rows; row += GROUP) rows_product<GROUP>(x, weight, row, column, traffic, emit);
        for (; row < rows; ++row) rows_product<1>(x, weight, row, column, traffic, emit);
    }
}

#endif

// rows of a tile by their terms: with bfloat16 two rows share a word; one without a partner gets zeros
void interleave(const T* x, int rows, T* out) {
#if HALF
    for (int row = 0; row < rows; row += 2)
        for (int c = 0; c < D; c += 16) {
            __m512i low = _mm512_cvtepu16_epi32(_mm256_loadu_si256((const __m256i*)(x + (int64_t)row * D + c)));
            __m512i high = _mm512_setzero_si512();
            if (row + 1 < rows) high = _mm512_cvtepu16_epi32(_mm256_loadu_si256((const __m256i*)(x + (int64_t)(row + 1) * D + c)));
            _mm512_storeu_si512(out + (int64_t)row * D + 2 * c, _mm512_or_si512(low, _mm512_slli_epi32(high, 16)));
        }
#endif
}

#if TILES

// (16, 16) words, rows D words apart, to out (16, 16), rows `out_row` words apart
inline void transpose(const Word* x, Word* out, int64_t out_row) {
    __m512i a[16], b[16];
#pragma GCC unroll 16
    for (int i = 0; i < 16; ++i) a[i] = _mm512_load_si512(x + i * D);
#pragma GCC unroll 8
    for (int i = 0; i < 16; i += 2) {
        b[i] = _mm512_unpacklo_epi32(a[i], a[i + 1]);
        b[i + 1] = _mm512_unpackhi_epi32(a[i], a[i + 1]);
    }
#pragma GCC unroll 4
    for (int i = 0; i < 16; i += 4) {
        a[i] = _mm512_unpacklo_epi64(b[i], b[i + 2]);
        a[i + 1] = _mm512_unpackhi_epi64(b[i], b[i + 2]);
        a[i + 2] = _mm512_unpacklo_epi64(b[i + 1], b[i + 3]);
        a[i + 3] = _mm512_unpackhi_epi64(b[i + 1], b[i + 3]);
    }
#pragma GCC unroll 4
    for (int i = 0; i < 4; ++i) {  // a[4 j + i] holds in its lane l column 4 l + i of rows 4 j to 4 j + 3
        const __m512i low01 = _mm512_shuffle_i32x4(a[i], a[4 + i], 0x88), high01 = _mm512_shuffle_i32x4(a[i], a[4 + i], 0xdd);
        const __m512i low23 = _mm512_shuffle_i32x4(a[8 + i], a[12 + i], 0x88), high23 = _mm512_shuffle_i32x4(a[8 + i], a[12 + i], 0xdd);
        _mm512_store_si512(out + i * out_row, _mm512_shuffle_i32x4(low01, low23, 0x88));
        _mm512_store_si512(out + (4 + i) * out_row, _mm512_shuffle_i32x4(high01, high23, 0x88));
        _mm512_store_si512(out + (8 + i) * out_row, _mm512_shuffle_i32x4(low01, low23, 0xdd));
        _mm512_store_si512(out + (12 + i) * out_row, _mm512_shuffle_i32x4(high01, high23, 0xdd));
    }
}

// total += leftᵀ right over the rows of a tile
void gram(const T* left, const T* right, int rows, float* total, Traffic& traffic) {
    constexpr int PAIRS = TILE / 2;
    alignas(64) static thread_local Word pairs[PAIRS * D], turned[D * PAIRS], other[PAIRS * D];
    const int terms = (rows + 31) / 32 * 32;
    interleave(left, rows, (T*)pairs);
    interleave(right, rows, (T*)other);
    for (Word* one : {pairs, other}) memset(one + (rows + 1) / 2 * D, 0, (size_t)(terms / 2 - (rows + 1) / 2) * D * sizeof(Word));
    for (int pair = 0; pair < terms / 2; pair += 16)
        for (int c = 0; c < D; c += 16) transpose(pairs + pair * D + c, turned + c * PAIRS + pair, PAIRS);
    const int64_t total_row = D * sizeof(float);
    for (int row = 0; row < D; row += 32)
        for (int column = 0; column < D; column += 32) {
            float *at = total + (int64_t)row * D + column, *below = at + 16 * D;
            _tile_loadd(0, at, total_row);
            _tile_loadd(1, at + 16, total_row);
            _tile_loadd(2, below, total_row);
            _tile_loadd(3, below + 16, total_row);
            accumulate_tiles((const T*)(turned + row * PAIRS), PAIRS * sizeof(Word), other + column, D * sizeof(Word), terms,
                             traffic);
            _tile_stored(0, at, total_row);
            _tile_stored(1, at + 16, total_row);
            _tile_stored(2, below, total_row);
            _tile_stored(3, below + 16, total_row);
        }
}

#else

// R rows of total, of a panel of columns, += leftᵀ right over the rows of a tile
template <int R>
inline void gram_rows(const Word* left, const Word* right, int steps, float* total, int row, int column, Traffic& traffic) {
    V sum[R][P];
    float* at = total + (int64_t)row * D + column;
#pragma GCC unroll 24
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 4
        for (int j = 0; j < P; ++j) sum[r][j] = load(at + r * D + LANES * j);
    accumulate<R>(sum, left + row, 1, D, right + column, D, steps, traffic);
#pragma GCC unroll 24
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 4
        for (int j = 0; j < P; ++j) store(at + r * D + LANES * j, sum[r][j]);
}

// total += leftᵀ right over the rows of a tile
void gram(const T* left, const T* right, int rows, float* total, Traffic& traffic) {
    alignas(64) static thread_local T a[TILE * D], b[TILE * D];
    if (HALF) {
        interleave(left, rows, a);
        interleave(right, rows, b);
        left = a, right = b;
    }
    const int steps = (rows + PER_WORD - 1) / PER_WORD;
    constexpr int REST = D % GRAM_ROWS;
    for (int column = 0; column < D; column += PANEL) {
        int row = 0;
        for (; row + GRAM_ROWS <= D; row += GRAM_ROWS)
            gram_rows<GRAM_ROWS>((const Word*)left, (const Word*)right, steps, total, row, column, traffic);
        if constexpr (REST > 0) gram_rows<REST>((const Word*)left, (const Word*)right, steps, total, row, column, traffic);
    }
}

#endif

inline void add_to(float* total, V v) { store(total, load(total) + v); }

// total += sum of the rows of a tile
inline void add_rows(const T* x, int rows, float* total) {
    for (int c = 0; c < D; c += PANEL) {
        V sum[P];
        for (int j = 0; j < P; ++j) sum[j] = load(total + c + LANES * j);
        for (int r = 0; r < rows; ++r)
#pragma GCC unroll 4
            for (int j = 0; j < P; ++j) sum[j] += load(x + (int64_t)r * D + c + LANES * j);
        for (int j = 0; j < P; ++j) store(total + c + LANES * j, sum[j]);
    }
}

inline V load_any(const void* p, int64_t at, int wide) {
    return wide ? load((const float*)p + at) : load((const T*)p + at);
}

// sums of consecutive rows of the same receiver
struct Sums {
    T* out;
    int64_t node;
    alignas(64) float sum[D];
    Sums(T* out) : out(out), node(-1) {}
    void move(int64_t next) {
        if (next == node) return;
        flush();
        node = next;
        for (int c = 0; c < D; ++c) sum[c] = 0;
    }
    void flush() {
        if (node >= 0)
            for (int c = 0; c < D; c += LANES) store(out + node * D + c, load(sum + c));
    }
};

}  // namespace

// whether this process may use tiles: Linux gives them to those that ask
extern "C" int tiles_are_given() {
#if TILES
    constexpr int ARCH_REQ_XCOMP_PERM = 0x1023, XFEATURE_XTILEDATA = 18;
    return syscall(SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA) == 0;
#else
    return 0;
#endif
}

struct Block {
    int64_t count;
    const T* x;      // edge latents, or the first layer's outputs before their ReLU
    const T* table;  // of edges: parts of the first layer per node, as receiver and as sender
    const int64_t *receivers, *senders;
    const T *first, *second, *third;  // weights in panels
    const float *bias_2, *bias_3, *scale, *shift;
    const void* residual;  // or null
    void* out;
    T* received;
    T *one, *two, *hat;  // kept for the backward pass, or null
    float* rstd;
    int64_t wide;  // whether residual and output are float32
    double eps;
};

namespace {

inline int rows_from(int64_t count, int64_t start) {
    const int64_t left = count - start;
    return left < 0 ? 0 : left < TILE ? (int)left : TILE;
}

// rows of an array with D columns, from a row on
inline void fetch_rows(Ahead& ahead, const void* x, int64_t row, int rows, int64_t bytes = sizeof(T)) {
    if (x) ahead.add((const char*)x + row * D * bytes, rows * D * bytes);
}

// what the tile that begins at a row reads
void fetch(Ahead& ahead, const Block* b, int64_t start) {
    const int rows = rows_from(b->count, start);
    ahead.clear();
    fetch_rows(ahead, b->x, start, rows);
    if (b->residual != b->x) fetch_rows(ahead, b->residual, start, rows, b->wide ? sizeof(float) : sizeof(T));
    for (int r = 0; b->table && r < rows; ++r) {
        const int64_t receiver = b->receivers[start + r], sender = b->senders[start + r];
        ahead.add(b->table + sender * 2 * D + D, D * sizeof(T));
        if (r == 0 || receiver != b->receivers[start + r - 1]) ahead.add(b->table + receiver * 2 * D, D * sizeof(T));
    }
}

// layer norm of a row: its normalised numbers, and 1 / their deviation before
inline float normalise(const float* row, float eps, V (&hat)[VECTORS]) {
    V sum = V{}, square = V{};
#pragma GCC unroll 16
    for (int j = 0; j < VECTORS; ++j) sum += hat[j] = load(row + LANES * j);
    const float mean = total(sum) / D;
#pragma GCC unroll 16
    for (int j = 0; j < VECTORS; ++j) {
        hat[j] -= mean;
        square += hat[j] * hat[j];
    }
    const float rstd = 1.0f / __builtin_sqrtf(total(square) / D + eps);
#pragma GCC unroll 16
    for (int j = 0; j < VECTORS; ++j) hat[j] *= rstd;
    return rstd;
}

}  // namespace

extern "C" void forward(const Block* b) {
    alignas(64) static thread_local T one[TILE * D], two[TILE * D], hats[TILE * D];
    alignas(64) static thread_local float raw[TILE * D], outs[TILE * D];
    [[maybe_unused]] const Tiles tiles;
    const bool keep = b->hat != nullptr;
    const int64_t out_bytes = b->wide ? sizeof(float) : sizeof(T);
    Sums sums(b->received);
    Traffic traffic;
    for (int64_t start = 0; start < b->count; start += TILE) {
        const int rows = rows_from(b->count, start);
        const T* x = b->x + start * D;
        fetch(traffic.ahead, b, start + TILE);
        const auto write = [&](const void* tile, void* kept, int64_t bytes) {
            if (keep) traffic.behind.add(tile, (char*)kept + start * D * bytes, rows * D * bytes);
        };
        if (b->table) {
            const int64_t *receivers = b->receivers + start, *senders = b->senders + start;
            product(x, rows, b->first, traffic, [&](int r, int c, V v) {
                const V ends = load(b->table + receivers[r] * 2 * D + c) + load(b->table + senders[r] * 2 * D + D + c);
                store(one + r * D + c, relu(v + ends));
            });
        } else {
            for (int i = 0; i < rows * D; i += LANES) store(one + i, relu(load(x + i)));
        }
        write(one, b->one, sizeof(T));
        product(one, rows, b->second, traffic, [&](int r, int c, V v) { store(two + r * D + c, relu(v + load(b->bias_2 + c))); });
        write(two, b->two, sizeof(T));
        product(two, rows, b->third, traffic, [&](int r, int c, V v) { store(raw + r * D + c, v + load(b->bias_3 + c)); });
        traffic.behind.finish();
        void* result = keep ? (void*)outs : (char*)b->out + start * D * out_bytes;
        for (int r = 0; r < rows; ++r) {
            V hat[VECTORS];
            const float rstd = normalise(raw + r * D, (float)b->eps, hat);
            if (keep) b->rstd[start + r] = rstd;
            if (b->received) sums.move(b->receivers[start + r]);
#pragma GCC unroll 16
            for (int j = 0; j < VECTORS; ++j) {
                const int c = LANES * j, i = r * D + c;
                if (keep) store(hats + i, hat[j]);
                V out = hat[j] * load(b->scale + c) + load(b->shift + c);
                if (b->received) add_to(sums.sum + c, out);
                if (b->residual) out += load_any(b->residual, start * D + i, b->wide);
                if (b->wide)
                    store((float*)result + i, out);
                else
                    store((T*)result + i, out);
            }
        }
        write(hats, b->hat, sizeof(T));
        write(outs, b->out, out_bytes);
    }
    traffic.behind.finish();
    flush_writes();
    if (b->received) sums.flush();
}

struct Gradient {
    int64_t count;
    const void* grad;   // at the output
    const T* grad_sum;  // of edges: at the sums
    const int64_t *receivers, *senders;
    const T *x, *one, *two, *hat;
    const float* rstd;
    const T *first, *second, *third;  // transposed weights in panels
    const float* scale;
    float *grad_first, *grad_second, *grad_third, *grad_bias_2, *grad_bias_3, *grad_scale, *grad_shift;  // are added to
    T* grad_x;
    float* grad_table;  // of edges: is added to
    int64_t wide;       // whether grad is float32
};

namespace {

// what the tile that begins at a row reads, after what this one reads at its end
void fetch(Ahead& ahead, const Gradient* b, int64_t start) {
    const int64_t next = start + TILE;
    const int rows = rows_from(b->count, next);
    ahead.clear();
    fetch_rows(ahead, b->grad, next, rows, b->wide ? sizeof(float) : sizeof(T));
    for (const T* kept : {b->hat, b->two, b->one}) fetch_rows(ahead, kept, next, rows);
    if (!b->first) return;
    for (int64_t r = start; r < start + rows_from(b->count, start); ++r)
        ahead.add(b->grad_table + b->senders[r] * 2 * D + D, D * sizeof(float));
    fetch_rows(ahead, b->x, next, rows);
}

// gradients at the layer norm's inputs of a tile, from those behind it
void through_norm(const Gradient* b, int64_t start, int rows, T* out) {
    for (int r = 0; r < rows; ++r) {
        const int64_t at = (start + r) * D;
        V g[VECTORS], mean = V{}, along = V{};
        const T* sum = b->grad_sum ? b->grad_sum + b->receivers[start + r] * D : nullptr;
#pragma GCC unroll 16
        for (int j = 0; j < VECTORS; ++j) {
            const int c = LANES * j;
            const V h = load(b->hat + at + c);
            g[j] = b->grad ? load_any(b->grad, at + c, b->wide) : V{};
            if (sum) g[j] += load(sum + c);
            add_to(b->grad_shift + c, g[j]);
            add_to(b->grad_scale + c, g[j] * h);
            g[j] *= load(b->scale + c);
            mean += g[j];
            along += g[j] * h;
        }
        const float m = total(mean) / D, a = total(along) / D, factor = b->rstd[start + r];
#pragma GCC unroll 16
        for (int j = 0; j < VECTORS; ++j) {
            const V h = load(b->hat + at + LANES * j);
            store(out + r * D + LANES * j, (g[j] - (a * h + m)) * factor);
        }
    }
}

// a tile's gradients at the first layer's outputs, added up at both ends of its edges
void add_to_ends(const Gradient* b, int64_t start, int rows, const T* hidden) {
    for (int r = 0; r < rows; ++r) {
        float* receiver = b->grad_table + b->receivers[start + r] * 2 * D;
        float* sender = b->grad_table + b->senders[start + r] * 2 * D + D;
        for (int c = 0; c < D; c += LANES) {
            const V v = load(hidden + r * D + c);
            add_to(receiver + c, v);
            add_to(sender + c, v);
        }
    }
}

}  // namespace

extern "C" void backward(const Gradient* b) {
    alignas(64) static thread_local T third[TILE * D], second[TILE * D], hidden[TILE * D];
    [[maybe_unused]] const Tiles tiles;
    Traffic traffic;
    for (int64_t start = 0; start < b->count; start += TILE) {
        const int rows = rows_from(b->count, start);
        const T *one = b->one + start * D, *two = b->two + start * D;
        const auto through_relu = [](const T* output, V v) { return load(output) > 0.0f ? v : V{}; };
        fetch(traffic.ahead, b, start);
        through_norm(b, start, rows, third);
        add_rows(third, rows, b->grad_bias_3);
        gram(third, two, rows, b->grad_third, traffic);
        product(third, rows, b->third, traffic,
                [&](int r, int c, V v) { store(second + r * D + c, through_relu(two + r * D + c, v)); });
        add_rows(second, rows, b->grad_bias_2);
        gram(second, one, rows, b->grad_second, traffic);
        if (!b->first) {
            product(second, rows, b->second, traffic,
                    [&](int r, int c, V v) { stream(b->grad_x + (start + r) * D + c, through_relu(one + r * D + c, v)); });
            continue;
        }
        product(second, rows, b->second, traffic,
                [&](int r, int c, V v) { store(hidden + r * D + c, through_relu(one + r * D + c, v)); });
        gram(hidden, b->x + start * D, rows, b->grad_first, traffic);
        product(hidden, rows, b->first, traffic, [&](int r, int c, V v) {
            const int64_t i = (start + r) * D + c;
            stream(b->grad_x + i, b->grad ? v + load((const T*)b->grad + i) : v);
        });
        add_to_ends(b, start, rows, hidden);
    }
    flush_writes();
}
