// What a network is shown of a step, and what its output leads to: columns of features, sums over neighbourhoods, corrections.
// Tables are float32, a row after the other, and belong to the caller; columns are written into wider tables with a given stride.
// Sums have a fixed order.
#include <cmath>
#include <cstdint>
#include <cstring>

#include "registers.h"

namespace {

typedef float F4 __attribute__((vector_size(16)));

constexpr int LANES = REGISTER / 4;  // numbers that are compressed at a time
typedef float V __attribute__((vector_size(4 * LANES)));
typedef int32_t I __attribute__((vector_size(4 * LANES)));

inline F4 load(const float* p) {
    F4 v;
    std::memcpy(&v, p, sizeof v);
    return v;
}
inline void store(float* p, F4 v) { std::memcpy(p, &v, sizeof v); }

inline float dot(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline float length(const float* a) { return std::sqrt(dot(a, a)); }

inline V root(V v) {
    alignas(64) float lanes[LANES];
    std::memcpy(lanes, &v, sizeof v);
    for (int i = 0; i < LANES; ++i) lanes[i] = std::sqrt(lanes[i]);
    std::memcpy(&v, lanes, sizeof v);
    return v;
}

// asinh, to two units of rounding: log1p(y + y^2 / (1 + sqrt(1 + y^2))) of the magnitude y; where y^2 is too large, log(y) + log 2.
inline V asinh_of(V x) {
    const I sign = (I)x & (int32_t)0x80000000;
    const V y = (V)((I)x ^ sign), zero = V{};
    const I large = y > 1e9f;
    const V small = large ? zero : y;
    const V s = large ? y : small + small * small / (1.0f + root(1.0f + small * small)), u = 1.0f + s;
    const V lost = (s - (u - 1.0f)) / u;  // what the sum has rounded away
    // u = m 2^e with m between sqrt(1/2) and sqrt(2).
    const I shifted = (I)u - 0x3f3504f3, exponent = shifted >> 23;
    const V m = (V)((shifted & 0x7fffff) + 0x3f3504f3), e = __builtin_convertvector(exponent, V);
    const V z = (m - 1.0f) / (m + 1.0f), w = z * z;
    const V series = 2.0f * z * (1.0f + w * (1.0f / 3 + w * (1.0f / 5 + w * (1.0f / 7 + w * (1.0f / 9)))));
    const float high = 0.693359375f, low = -2.12194440e-4f;  // of log 2
    const V result = e * high + (series + lost + e * low) + (large ? zero + 0.69314718f : zero);
    const V sound = y > 3.4028235e38f ? y : result;
    return (V)((I)sound | sign);
}

// Numbers on their way to asinh, and where they go.
struct Compressor {
    alignas(64) float values[LANES] = {};
    float* places[LANES];
    int count = 0;
    void add(float value, float* place) {
        values[count] = value;
        places[count++] = place;
        if (count == LANES) flush();
    }
    void flush() {
        V v;
        std::memcpy(&v, values, sizeof v);
        v = asinh_of(v);
        std::memcpy(values, &v, sizeof v);
        for (int i = 0; i < count; ++i) *places[i] = values[i];
        count = 0;
    }
    ~Compressor() { flush(); }
};

inline void cross_of(const float* pos, const int64_t* face, float* c) {
    float u[3], v[3];
    for (int k = 0; k < 3; ++k) {
        u[k] = pos[3 * face[1] + k] - pos[3 * face[0] + k];
        v[k] = pos[3 * face[2] + k] - pos[3 * face[0] + k];
    }
    c[0] = u[1] * v[2] - u[2] * v[1], c[1] = u[2] * v[0] - u[0] * v[2], c[2] = u[0] * v[1] - u[1] * v[0];
}

}  // namespace

extern "C" {

// Matched planes of the body, or none: valid is null without contact.
struct Planes {
    const uint8_t* valid;              // (V)
    const float *dist, *point, *next_point, *next_normal;  // (V) m at t, (V, 3)
};

// Who is next to whom: those of vertex v are other[first[v]] ... other[first[v + 1] - 1].
struct Neighbours {
    int64_t count;
    const int64_t *first, *other;
};
}

namespace {

inline float distance_of(const Planes& planes, int64_t v, const float* pos) {
    float gap[3];
    for (int k = 0; k < 3; ++k) gap[k] = pos[k] - planes.next_point[3 * v + k];
    return dot(gap, planes.next_normal + 3 * v);
}

inline void push_out(const Planes& planes, int64_t v, float clearance, float* pos) {
    if (!planes.valid || !planes.valid[v]) return;
    const float depth = clearance - distance_of(planes, v, pos);
    if (!(depth <= 0.0f))
        for (int k = 0; k < 3; ++k) pos[k] += depth * planes.next_normal[3 * v + k];
}

}  // namespace

extern "C" {

// ---- columns -------------------------------------------------------------------------------------------------------------

// asinh(x / scale) of x (N, width).
void features_asinh(const float* x, int64_t count, int64_t width, float scale, float* out, int64_t stride) {
    Compressor numbers;
    for (int64_t i = 0; i < count; ++i)
        for (int64_t c = 0; c < width; ++c) numbers.add(x[i * width + c] / scale, out + i * stride + c);
}

// asinh(|x| / scale) of x (N, 3).
void features_size(const float* x, int64_t count, float scale, float* out, int64_t stride) {
    Compressor numbers;
    for (int64_t i = 0; i < count; ++i) numbers.add(length(x + 3 * i) / scale, out + i * stride);
}

// asinh((v dt - (base - pos)) / scale); dt (V).
void features_moved(const float* pos, const float* vel, const float* dt, const float* base, int64_t count, float scale, float* out,
                    int64_t stride) {
    Compressor numbers;
    for (int64_t i = 0; i < count; ++i)
        for (int k = 0; k < 3; ++k)
            numbers.add((vel[3 * i + k] * dt[i] - (base[3 * i + k] - pos[3 * i + k])) / scale, out + i * stride + k);
}

// asinh((next - 2 pos + before) / scale) of some vertices.
void features_swing(const float* pos, const float* next, const float* before, const int64_t* rows, int64_t count, float scale,
                    float* out, int64_t stride) {
    Compressor numbers;
    for (int64_t i = 0; i < count; ++i)
        for (int k = 0; k < 3; ++k) {
            const int64_t at = 3 * rows[i] + k;
            numbers.add((next[at] - 2.0f * pos[at] + before[at]) / scale, out + i * stride + k);
        }
}

// Area-weighted unit normals of some vertices (all of them where rows is null); zero where undefined.
void features_normals(const float* pos, const int64_t* faces, const int64_t* around, const int64_t* first, const int64_t* valence,
                      const int64_t* rows, int64_t count, float* out, int64_t stride) {
    for (int64_t i = 0; i < count; ++i) {
        const int64_t v = rows ? rows[i] : i;
        float sum[3] = {0, 0, 0}, c[3];
        for (int64_t j = first[v]; j < first[v] + valence[v]; ++j) {
            cross_of(pos, faces + 3 * around[j], c);
            for (int k = 0; k < 3; ++k) sum[k] += c[k];
        }
        const float size = length(sum), factor = size > 1.17549435e-38f ? 1.0f / size : size != size ? size : 0.0f;
        for (int k = 0; k < 3; ++k) out[i * stride + k] = factor * sum[k];
    }
}

// Signed distance to the body, clamped, and as many columns of its normal as there are (width 1 or 4).
void features_contact(const Planes* planes, const float* base, int64_t count, float reach, float scale, int64_t width, float* out,
                      int64_t stride) {
    for (int64_t v = 0; v < count; ++v) {
        const bool valid = planes->valid && planes->valid[v];
        float dist = valid ? distance_of(*planes, v, base + 3 * v) : reach;
        dist = dist < -reach ? -reach : dist > reach ? reach : dist;
        float* row = out + v * stride;
        row[0] = dist / scale;
        for (int64_t k = 1; k < width; ++k) row[k] = valid ? planes->next_normal[3 * v + k - 1] : 0.0f;
    }
}

// (sender - receiver) / scale and its length of edges; scale is one number, or one per edge where scales is given.
void features_relative(const float* pos, const int64_t* senders, const int64_t* receivers, int64_t count, float scale,
                       const float* scales, float* out, int64_t stride) {
    for (int64_t i = 0; i < count; ++i) {
        const float *a = pos + 3 * senders[i], *b = pos + 3 * receivers[i], unit = scales ? scales[i] : scale;
        const float d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
        float* row = out + i * stride;
        for (int k = 0; k < 3; ++k) row[k] = d[k] / unit;
        row[3] = length(d) / unit;
    }
}

// asinh((length / rest - 1) / scale) of edges; 0 where there is no rest length.
void features_strain(const float* pos, const int64_t* senders, const int64_t* receivers, const float* rest, int64_t count,
                     float scale, float* out, int64_t stride) {
    Compressor numbers;
    for (int64_t i = 0; i < count; ++i) {
        const float *a = pos + 3 * senders[i], *b = pos + 3 * receivers[i];
        const float d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
        numbers.add(rest[i] > 1e-6f ? (length(d) / rest[i] - 1.0f) / scale : 0.0f, out + i * stride);
    }
}

// ---- neighbourhoods ------------------------------------------------------------------------------------------------------

// Residuals force / mass (V, 3), and those of neighbourhoods: sums of both after some rounds of diffusion, each to more columns.
// memory (3, V, 4).
void features_residuals(const Neighbours* mesh, const float* force, const float* mass, const int64_t* rounds, int64_t num_rounds,
                        float* residual, float* wide, float* memory) {
    const int64_t count = mesh->count, width = 3 * num_rounds;
    float *values = memory, *shares = memory + 4 * count, *next = memory + 8 * count;
    for (int64_t v = 0; v < count; ++v) {
        store(values + 4 * v, F4{force[3 * v], force[3 * v + 1], force[3 * v + 2], mass[v]});
        for (int k = 0; k < 3; ++k) residual[3 * v + k] = force[3 * v + k] / mass[v];
    }
    int64_t done = 0;
    for (int64_t r = 0; r < num_rounds; ++r) {
        for (; done < rounds[r]; ++done) {
            for (int64_t v = 0; v < count; ++v) {
                const int64_t degree = mesh->first[v + 1] - mesh->first[v];
                store(shares + 4 * v, 0.5f / (float)(degree > 1 ? degree : 1) * load(values + 4 * v));
            }
            for (int64_t v = 0; v < count; ++v) {
                F4 sum = F4{};
                for (int64_t i = mesh->first[v]; i < mesh->first[v + 1]; ++i) sum += load(shares + 4 * mesh->other[i]);
                store(next + 4 * v, 0.5f * load(values + 4 * v) + sum);
            }
            float* before = values;
            values = next;
            next = before;
        }
        for (int64_t v = 0; v < count; ++v)
            for (int k = 0; k < 3; ++k) wide[width * v + 3 * r + k] = values[4 * v + k] / values[4 * v + 3];
    }
}

// u (V, 4) with (diag(weight) + firm n nT + k L) u = force (V, 3) where free, L the mesh's graph Laplacian, and u = 0 elsewhere:
// conjugate gradients with the blocks of single vertices as preconditioner. firm (V) and its unit directions n (V, 3) may be null.
// The scenes do not touch each other and take as many steps as `steps` says of each; a vertex is of scene[v], all of the first one
// if there is no such table. sums (3, scenes), memory (5, V, 4).
void features_fit(const Neighbours* mesh, const float* weight, const float* firm, const float* normal, const float* force,
                  const uint8_t* free, const int64_t* scene, int64_t scenes, const int64_t* steps, float k, float* u, double* sums,
                  float* memory) {
    const int64_t count = mesh->count;
    float *r = memory, *p = memory + 4 * count, *q = memory + 8 * count, *inverse = memory + 12 * count;
    float* across = memory + 16 * count;  // n, and by how much less it is preconditioned along n
    double *rz = sums, *pq = sums + scenes, *after = sums + 2 * scenes;
    int64_t most = 0;
    for (int64_t s = 0; s < scenes; ++s) {
        rz[s] = 0.0;
        most = steps[s] > most ? steps[s] : most;
    }
    const auto of = [scene](int64_t v) { return scene ? scene[v] : 0; };
    const auto add = [](double* sum, F4 a, F4 b) {
        const F4 c = a * b;
        *sum += (double)c[0] + (double)c[1] + (double)c[2];
    };
    const auto along = [](F4 n, F4 value) { return n[0] * value[0] + n[1] * value[1] + n[2] * value[2]; };
    const auto precondition = [&](int64_t v, F4 value) {
        if (!firm) return inverse[4 * v] * value;
        const F4 n = load(across + 4 * v);
        return inverse[4 * v] * (value - n[3] * along(n, value) * F4{n[0], n[1], n[2], 0.0f});
    };
    for (int64_t v = 0; v < count; ++v) {
        const float degree = (float)(mesh->first[v + 1] - mesh->first[v]), diagonal = weight[v] + k * degree;
        if (firm) {
            const float* n = normal + 3 * v;
            store(across + 4 * v, F4{n[0], n[1], n[2], firm[v] / (diagonal + firm[v])});
        }
        inverse[4 * v] = free[v] ? 1.0f / diagonal : 0.0f;
        inverse[4 * v + 1] = diagonal;
        const F4 given = free[v] ? F4{force[3 * v], force[3 * v + 1], force[3 * v + 2], 0.0f} : F4{};
        store(r + 4 * v, given);
        store(p + 4 * v, precondition(v, given));
        store(u + 4 * v, F4{});
        add(rz + of(v), given, load(p + 4 * v));
    }
    for (int64_t step = 0; step < most; ++step) {
        for (int64_t s = 0; s < scenes; ++s) pq[s] = after[s] = 0.0;
        for (int64_t v = 0; v < count; ++v) {
            F4 sum = F4{};
            for (int64_t i = mesh->first[v]; i < mesh->first[v + 1]; ++i) sum += load(p + 4 * mesh->other[i]);
            const F4 own = load(p + 4 * v);
            F4 here = inverse[4 * v + 1] * own - k * sum;
            if (firm) {
                const F4 n = load(across + 4 * v);
                here += firm[v] * along(n, own) * F4{n[0], n[1], n[2], 0.0f};
            }
            store(q + 4 * v, here);
            add(pq + of(v), own, here);
        }
        for (int64_t v = 0; v < count; ++v) {
            const int64_t s = of(v);
            const float length = step < steps[s] && pq[s] > 0.0 ? (float)(rz[s] / pq[s]) : 0.0f;
            store(u + 4 * v, load(u + 4 * v) + length * load(p + 4 * v));
            const F4 left = free[v] ? load(r + 4 * v) - length * load(q + 4 * v) : F4{};
            store(r + 4 * v, left);
            add(after + s, left, precondition(v, left));
        }
        for (int64_t v = 0; v < count; ++v) {
            const int64_t s = of(v);
            const float share = rz[s] > 0.0 ? (float)(after[s] / rz[s]) : 0.0f;
            store(p + 4 * v, precondition(v, load(r + 4 * v)) + share * load(p + 4 * v));
        }
        for (int64_t s = 0; s < scenes; ++s) rz[s] = after[s];
    }
}

// Positions that have moved with the body: its matched points' way, averaged over growing neighbourhoods with the trust that a
// vertex has in its own (1 where pinned, falling with the distance over `reach`), then out of the body. memory (3, V, 4).
void features_base(const Neighbours* mesh, const Planes* planes, const float* pos, const uint8_t* pinned, const float* target,
                   float reach, float clearance, int64_t rounds, float* base, float* memory) {
    const int64_t count = mesh->count;
    float *total = memory, *now = memory + 4 * count, *next = memory + 8 * count;
    for (int64_t v = 0; v < count; ++v) {
        const float dist = planes->dist[v] > 0.0f ? planes->dist[v] / reach : 0.0f;
        const bool held = target && pinned[v];
        const float trust = held ? 1.0f : 1.0f / (1.0f + 3.0f * dist * dist);
        float way[3];
        for (int k = 0; k < 3; ++k) {
            const int64_t at = 3 * v + k;
            way[k] = held ? target[at] - pos[at] : planes->next_point[at] - planes->point[at];
        }
        const F4 row = F4{way[0] * trust, way[1] * trust, way[2] * trust, trust};
        store(total + 4 * v, row);
        store(now + 4 * v, row);
    }
    for (int64_t round = 0; round < rounds; ++round) {
        for (int64_t v = 0; v < count; ++v) {
            F4 sum = F4{};
            for (int64_t i = mesh->first[v]; i < mesh->first[v + 1]; ++i) sum += load(now + 4 * mesh->other[i]);
            const int64_t degree = mesh->first[v + 1] - mesh->first[v];
            const F4 own = load(total + 4 * v);
            const float trust = own[3];
            store(next + 4 * v, trust * own + (1.0f - 0.5f * trust) * (sum / (float)(degree > 1 ? degree : 1)));
        }
        float* before = now;
        now = next;
        next = before;
    }
    for (int64_t v = 0; v < count; ++v) {
        const float weight = now[4 * v + 3] > 1e-12f ? now[4 * v + 3] : 1e-12f;
        for (int k = 0; k < 3; ++k) base[3 * v + k] = pos[3 * v + k] + now[4 * v + k] / weight;
        push_out(*planes, v, clearance, base + 3 * v);
    }
}

// ---- corrections ---------------------------------------------------------------------------------------------------------

// A pass of local steps: from `last` (V, 3) by the raw output (V, 5), the vertices' own steps and the pass before (or null), then
// out of the body; vertices that are not free go to `fixed`.
void features_take(const Planes* planes, const float* raw, const float* step, const float* before, const float* last,
                   const uint8_t* free, const float* fixed, int64_t count, float scale, float gain, float longest, float clearance,
                   float* pos) {
    for (int64_t v = 0; v < count; ++v) {
        const float* output = raw + 5 * v;
        const float size = length(step + 3 * v), share = (output[3] + gain) * (longest / (size < longest ? longest : size));
        float* at = pos + 3 * v;
        for (int k = 0; k < 3; ++k) {
            float way = scale * output[k] + share * step[3 * v + k];
            if (before) way += output[4] * before[3 * v + k];
            at[k] = last[3 * v + k] + way;
        }
        push_out(*planes, v, clearance, at);
        for (int k = 0; k < 3 && !free[v]; ++k) at[k] = fixed[3 * v + k];
    }
}
}
