// A network's inference in float32: perceptrons over rows, and whole processor steps (edge networks, sums at the receivers, node
// network) in one call. Rows are taken in tiles that stay in cache from the first layer to the layer norm; nothing is allocated.
// Weights lie in panels (network_pack), so that any width is a loop over full vectors. Every sum has a fixed order.
#include <cmath>
#include <cstdint>
#include <cstring>

#include "ahead.h"
#include "floats.h"

namespace {

constexpr int TILE = 96;       // rows: a multiple of every group of rows below
constexpr int MOST = 512;      // columns of a latent
constexpr int STEPS = 4;       // terms of a sum between two lines that are asked for
alignas(64) constexpr float NOTHING[MOST] = {};

constexpr int padded(int64_t count) { return (int)((count + LANES - 1) / LANES * LANES); }

// Vectors of a panel of columns.
constexpr int panel_of(int64_t columns) {
    const int vectors = padded(columns) / LANES;
    return vectors % 4 == 0 ? 4 : vectors % 3 == 0 ? 3 : vectors % 2 == 0 ? 2 : 1;
}

// ---- products ------------------------------------------------------------------------------------------------------------

// Rows of a table: one after the other, or at places; with a stride of 0 all the same.
template <class T> struct Rows {
    T* from = nullptr;
    int64_t stride = 0;
    const int64_t* places = nullptr;
    inline T* at(int r) const { return from + (places ? places[r] : r) * stride; }
};

// Where a product goes: its sums and rows of one or two tables, no less than a floor. Not a function for each use: the loops around
// the sums would be compiled as many times.
struct Goal {
    Rows<float> out;
    Rows<const float> add, more;
    float floor = -__builtin_inff();
};

// R rows of x W, of the panel of P vectors that begins at a column.
template <int R, int P>
inline void rows_product(const float* x, int64_t stride, int terms, const float* panel, int row, int column, Ahead& ahead,
                         const Goal& goal) {
    V sum[R][P];
#pragma GCC unroll 24
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 4
        for (int j = 0; j < P; ++j) sum[r][j] = V{};
    const float* from = x + row * stride;
    for (int k = 0; k < terms; ++k) {
        if (k % STEPS == 0) ahead.turn();
        V weight[P];
#pragma GCC unroll 4
        for (int j = 0; j < P; ++j) weight[j] = load(panel + (k * P + j) * LANES);
#pragma GCC unroll 24
        for (int r = 0; r < R; ++r)
#pragma GCC unroll 4
            for (int j = 0; j < P; ++j) sum[r][j] += from[r * stride + k] * weight[j];
    }
    const V floor = all(goal.floor);
#pragma GCC unroll 24
    for (int r = 0; r < R; ++r) {
        const float *add = goal.add.at(row + r) + column, *more = goal.more.from ? goal.more.at(row + r) + column : nullptr;
        float* out = goal.out.at(row + r) + column;
#pragma GCC unroll 4
        for (int j = 0; j < P; ++j) {
            V v = sum[r][j] + load(add + j * LANES);
            if (more) v += load(more + j * LANES);
            store(out + j * LANES, v < floor ? floor : v);  // keeps a NaN
        }
    }
}

template <int P>
inline void panels_product(const float* x, int64_t stride, int rows, int terms, const float* weight, int columns, Ahead& ahead,
                           const Goal& goal) {
    constexpr int GROUP = SUMS / P;
    for (int column = 0; column < columns; column += P * LANES, weight += (int64_t)terms * P * LANES) {
        int row = 0;
        for (; row + GROUP <= rows; row += GROUP) rows_product<GROUP, P>(x, stride, terms, weight, row, column, ahead, goal);
        for (; row < rows; ++row) rows_product<1, P>(x, stride, terms, weight, row, column, ahead, goal);
    }
}

// All rows of a tile by all columns of a packed weight.
void product(const float* x, int64_t stride, int rows, int64_t terms, const float* weight, int64_t columns, Ahead& ahead,
             const Goal& goal) {
    const int wide = padded(columns);
    switch (panel_of(columns)) {
        case 4: return panels_product<4>(x, stride, rows, (int)terms, weight, wide, ahead, goal);
        case 3: return panels_product<3>(x, stride, rows, (int)terms, weight, wide, ahead, goal);
        case 2: return panels_product<2>(x, stride, rows, (int)terms, weight, wide, ahead, goal);
        default: return panels_product<1>(x, stride, rows, (int)terms, weight, wide, ahead, goal);
    }
}

}  // namespace

extern "C" {

// in -> width -> width -> out; weights in panels, biases padded with zeros to whole vectors.
struct Perceptron {
    const float *first, *second, *third, *bias_1, *bias_2, *bias_3;
    const float *scale, *shift;  // of the layer norm, or null
    int64_t in, width, out;
    double eps;
};

// Which edges of a set take part, their ends among the nodes that have one, and those nodes.
struct Edges {
    int64_t num_edges, num_nodes;
    const int64_t *senders, *receivers;  // (E) into nodes, receivers ascending
    const int64_t* nodes;                // (M)
    const int64_t* rows;                 // (E) of the latents, or null for all of them
    const int64_t* offsets;              // (M + 1)
};

// The part of one edge set in a processor step.
struct Part {
    const float *to_receiver, *to_sender, *to_edge, *to_node;  // blocks of columns of the first layers
    Perceptron network;                                        // of the edges; its first weight is not read
    int64_t edges, latent;                                     // which of the lists given
};

struct Step {
    const Part* parts;
    const float* own;     // the nodes' block of columns of the node network's first layer
    Perceptron network;   // of the nodes; its first weight is not read
    int64_t num_parts, mean;
};

// Memory of a step: two tables (N, d) of the nodes' parts of a first layer, sums and hidden layer (N, d).
struct Memory {
    float *receiver, *sender, *received, *hidden;
};
}

namespace {

// The layer norm of a row, in place. N: its vectors where that is known beforehand, 0: any number.
template <int N> inline void normalise(const Perceptron& p, float* row) {
    const int d = N ? N * LANES : (int)p.width;
    V sum = V{}, square = V{};
#pragma GCC unroll 8
    for (int c = 0; c < d; c += LANES) sum += load(row + c);
    const V mean = all(total(sum) / (float)d);
#pragma GCC unroll 8
    for (int c = 0; c < d; c += LANES) {
        const V centred = load(row + c) - mean;
        square += centred * centred;
    }
    const V factor = all(1.0f / std::sqrt(total(square) / (float)d + (float)p.eps));
#pragma GCC unroll 8
    for (int c = 0; c < d; c += LANES) store(row + c, (load(row + c) - mean) * factor * load(p.scale + c) + load(p.shift + c));
}

void normalise_rows(const Perceptron& p, float* rows, int count) {
    const int d = (int)p.width;
    for (int r = 0; r < count; ++r) switch (d / LANES) {
            case 3: normalise<3>(p, rows + r * d); break;
            case 8: normalise<8>(p, rows + r * d); break;
            default: normalise<0>(p, rows + r * d);
        }
}

// The layers behind the first, from its output before the ReLU (in `one`, which is overwritten); rows of padded(p.out) in `raw`.
void layers_behind(const Perceptron& p, float* one, int rows, Ahead& ahead, float* raw) {
    alignas(64) static thread_local float two[TILE * MOST];
    const int d = (int)p.width, out = padded(p.out);
    for (int i = 0; i < rows * d; i += LANES) store(one + i, relu(load(one + i)));
    product(one, d, rows, d, p.second, d, ahead, {{two, d}, {p.bias_2}, {}, 0.0f});
    product(two, d, rows, d, p.third, p.out, ahead, {{raw, out}, {p.bias_3}, {}});
    if (p.scale) normalise_rows(p, raw, rows);
}

// The same, and finish(row, result of a row).
template <class Finish> void tail(const Perceptron& p, float* one, int rows, Ahead& ahead, const Finish& finish) {
    alignas(64) static thread_local float raw[TILE * MOST];
    layers_behind(p, one, rows, ahead, raw);
    for (int r = 0; r < rows; ++r) finish(r, raw + r * padded(p.out));
}

inline void gather(const float* x, const int64_t* rows, int count, int d, float* out) {
    for (int r = 0; r < count; ++r) std::memcpy(out + r * d, x + rows[r] * d, sizeof(float) * d);
}

inline int tile_of(int64_t count, int64_t start) { return count - start < TILE ? (int)(count - start) : TILE; }

// Of the tile that begins at a row: its rows of x, and those at places.
void fetch_rows(Ahead& ahead, const float* x, int64_t count, int64_t start, int d) {
    if (start < count) ahead.add(x + start * d, sizeof(float) * tile_of(count, start) * d);
}
void fetch_places(Ahead& ahead, const float* x, const int64_t* places, int64_t count, int64_t start, int d) {
    for (int64_t i = start; i < count && i < start + TILE; ++i)
        if (i == start || places[i] != places[i - 1]) ahead.add(x + places[i] * d, sizeof(float) * d);
}

// Sums of consecutive rows of one receiver.
struct Sums {
    float* out;
    int d;
    int64_t node = -1;
    alignas(64) float sum[MOST];
    Sums(float* out, int d) : out(out), d(d) {}
    void add(int64_t receiver, const float* row) {
        if (receiver != node) {
            flush();
            node = receiver;
            std::memcpy(sum, row, sizeof(float) * d);
        } else {
            for (int c = 0; c < d; c += LANES) store(sum + c, load(sum + c) + load(row + c));
        }
    }
    void flush() {
        if (node >= 0) std::memcpy(out + node * d, sum, sizeof(float) * d);
    }
};

// Node parts of the edge network's first layer, at the nodes that have an edge.
void node_parts(const Part& part, const Edges& edges, const float* nodes, const Memory& memory) {
    alignas(64) static thread_local float tile[TILE * MOST];
    const int d = (int)part.network.width;
    Ahead ahead;
    for (int64_t start = 0; start < edges.num_nodes; start += TILE) {
        const int rows = tile_of(edges.num_nodes, start);
        gather(nodes, edges.nodes + start, rows, d, tile);
        ahead.clear();
        fetch_places(ahead, nodes, edges.nodes, edges.num_nodes, start + TILE, d);
        float *receiver = memory.receiver + start * d, *sender = memory.sender + start * d;
        product(tile, d, rows, d, part.to_receiver, d, ahead, {{receiver, d}, {part.network.bias_1}, {}});
        product(tile, d, rows, d, part.to_sender, d, ahead, {{sender, d}, {NOTHING}, {}});
    }
}

// e' = e + m and the sums of m at the receivers.
void update_edges(const Part& part, const Edges& edges, float* latent, const Memory& memory) {
    alignas(64) static thread_local float tile[TILE * MOST], one[TILE * MOST];
    const int d = (int)part.network.width;
    Sums sums(memory.received, d);
    Ahead ahead;
    for (int64_t start = 0; start < edges.num_edges; start += TILE) {
        const int rows = tile_of(edges.num_edges, start);
        const int64_t *receivers = edges.receivers + start, *senders = edges.senders + start;
        const int64_t* places = edges.rows ? edges.rows + start : nullptr;
        const float* x = latent + start * d;
        if (places) {
            gather(latent, places, rows, d, tile);
            x = tile;
        }
        ahead.clear();
        if (places)
            fetch_places(ahead, latent, edges.rows, edges.num_edges, start + TILE, d);
        else
            fetch_rows(ahead, latent, edges.num_edges, start + TILE, d);
        fetch_places(ahead, memory.sender, edges.senders, edges.num_edges, start + TILE, d);
        product(x, d, rows, d, part.to_edge, d, ahead, {{one, d}, {memory.receiver, d, receivers}, {memory.sender, d, senders}});
        tail(part.network, one, rows, ahead, [&](int r, const float* message) {
            float* at = latent + (places ? places[r] : start + r) * d;
            for (int c = 0; c < d; c += LANES) store(at + c, load(at + c) + load(message + c));
            sums.add(receivers[r], message);
        });
    }
    sums.flush();
}

// The sums' part of the node network's first layer.
void add_received(const Part& part, const Edges& edges, bool mean, const Memory& memory) {
    const int d = (int)part.network.width;
    Ahead ahead;
    for (int64_t start = 0; start < edges.num_nodes; start += TILE) {
        const int rows = tile_of(edges.num_nodes, start);
        ahead.clear();
        fetch_places(ahead, memory.hidden, edges.nodes, edges.num_nodes, start, d);
        fetch_rows(ahead, memory.received, edges.num_nodes, start + TILE, d);
        float* received = memory.received + start * d;
        for (int r = 0; mean && r < rows; ++r) {
            const int64_t degree = edges.offsets[start + r + 1] - edges.offsets[start + r];
            for (int c = 0; c < d; c += LANES) store(received + r * d + c, load(received + r * d + c) / (float)(degree > 1 ? degree : 1));
        }
        const int64_t* nodes = edges.nodes + start;
        product(received, d, rows, d, part.to_node, d, ahead, {{memory.hidden, d, nodes}, {memory.hidden, d, nodes}, {}});
    }
}

void take_step(const Step& step, const Edges* edges, float* const* latents, float* nodes, int64_t num_nodes, const Memory& memory) {
    alignas(64) static thread_local float tile[TILE * MOST];
    const int d = (int)step.network.width;
    Ahead ahead;
    for (int64_t start = 0; start < num_nodes; start += TILE) {
        ahead.clear();
        fetch_rows(ahead, nodes, num_nodes, start + TILE, d);
        product(nodes + start * d, d, tile_of(num_nodes, start), d, step.own, d, ahead,
                {{memory.hidden + start * d, d}, {step.network.bias_1}, {}});
    }
    for (int64_t i = 0; i < step.num_parts; ++i) {
        const Part& part = step.parts[i];
        const Edges& set = edges[part.edges];
        if (set.num_edges == 0) continue;
        node_parts(part, set, nodes, memory);
        update_edges(part, set, latents[part.latent], memory);
        add_received(part, set, step.mean, memory);
    }
    for (int64_t start = 0; start < num_nodes; start += TILE) {
        const int rows = tile_of(num_nodes, start);
        std::memcpy(tile, memory.hidden + start * d, sizeof(float) * rows * d);
        ahead.clear();
        fetch_rows(ahead, nodes, num_nodes, start, d);
        fetch_rows(ahead, memory.hidden, num_nodes, start + TILE, d);
        tail(step.network, tile, rows, ahead, [&](int r, const float* change) {
            float* at = nodes + (start + r) * d;
            for (int c = 0; c < d; c += LANES) store(at + c, load(at + c) + load(change + c));
        });
    }
}

}  // namespace

extern "C" {

// ---- what is called ------------------------------------------------------------------------------------------------------

int64_t network_most() { return MOST; }
int64_t network_padded(int64_t columns) { return padded(columns); }
// Latents have to fill whole vectors.
int64_t network_lanes() { return LANES; }

// Columns first .. first + terms of a weight (columns, stride) as panels: of each its vectors, term by term.
void network_pack(const float* weight, int64_t columns, int64_t stride, int64_t first, int64_t terms, float* out) {
    const int panel = panel_of(columns) * LANES;
    for (int64_t start = 0; start < padded(columns); start += panel)
        for (int64_t k = 0; k < terms; ++k)
            for (int64_t c = start; c < start + panel; ++c) *out++ = c < columns ? weight[c * stride + first + k] : 0.0f;
}

// A perceptron over rows of x (count, in) into out (count, p.out), on top of what is there if `add`.
void network_rows(const Perceptron* p, const float* x, int64_t count, float* out, int64_t add) {
    alignas(64) static thread_local float one[TILE * MOST];
    const int d = (int)p->width;
    Ahead ahead;
    for (int64_t start = 0; start < count; start += TILE) {
        const int rows = tile_of(count, start);
        ahead.clear();
        fetch_rows(ahead, x, count, start + TILE, (int)p->in);
        product(x + start * p->in, p->in, rows, p->in, p->first, d, ahead, {{one, d}, {p->bias_1}, {}});
        tail(*p, one, rows, ahead, [&](int r, const float* row) {
            float* at = out + (start + r) * p->out;
            for (int64_t c = 0; c < p->out; ++c) at[c] = add ? at[c] + row[c] : row[c];
        });
    }
}

// latent (count, d) += x (count) times weight (d), plus bias (d).
void network_lift(const float* x, int64_t count, int64_t d, const float* weight, const float* bias, float* latent) {
    for (int64_t i = 0; i < count; ++i)
        for (int64_t c = 0; c < d; c += LANES) {
            float* at = latent + i * d + c;
            store(at, load(at) + (all(x[i]) * load(weight + c) + load(bias + c)));
        }
}

// Processor steps one after the other, in place.
void network_steps(const Step* steps, int64_t count, const Edges* edges, float* const* latents, float* nodes, int64_t num_nodes,
                   const Memory* memory) {
    for (int64_t i = 0; i < count; ++i) take_step(steps[i], edges, latents, nodes, num_nodes, *memory);
}
}
