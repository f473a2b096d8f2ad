// What samples see of a surface, and what light arrives there.
#pragma once
#include <algorithm>
#include <vector>

#include "picture_lanes.h"
#include "picture_light.h"

extern "C" {

// As `SeenValues` of hood/media/renderer/raster.py: what is drawn, and from where.
struct Seen {
    const double *pos, *color, *normal, *shine;           // (V, 3) of vertices
    const double *screen, *depth;                         // (V, 2) pixels, (V,) m
    const double* hem;                                    // (V,) m from the next hem
    const int64_t* faces;                                 // (F, 3)
    const int32_t* face;                                  // (height, width) of each sample, -1 where nothing is drawn
    const float* nearness;                                // (height, width) 1/m
    const double* around;                                 // (4, num_around, 2) shares of the reach, by the pixel's place in its four
    const double* axes;                                   // (3, 3) right, up, forward
    const double* own;  // (height, width, 3) colours instead of those of vertices where not NaN; null: nowhere
    int64_t width, height, num_around;
    int64_t left, top;      // samples of the picture beside and above these, even
    double eye[3];
    double middle[2];       // samples: where the camera looks, across and down
    double focal, reach;    // samples, m
};
}

namespace {

// What is known of a vertex, in a cache line: its place from the eye, colour, normal, shine, distance from the hem, 1/depth, place on
// screen; and the same between vertices.
enum { POS = 0, COLOR = 3, NORMAL = 6, SHINE = 9, HEM = 12, NEARNESS = 13, SCREEN = 14, VALUES = 16 };
struct alignas(4 * VALUES) Values {
    float of[VALUES];
};

// Samples, as many as lanes.
struct Samples {
    int32_t row[LANES], column[LANES];
};

// What samples see: values between vertices, and unit normals towards the eye.
struct Sight {
    Values mean[LANES];
    Three normal;

    V part(int k) const {
        return gather([&](int i) { return mean[i].of[k]; });
    }
    Three parts(int first) const { return {part(first), part(first + 1), part(first + 2)}; }
};

struct Surface {
    const Seen& s;
    std::vector<Values>& vertices;

    Surface(const Seen& seen, int64_t count, std::vector<Values>& memory) : s(seen), vertices(memory) {
        vertices.resize(count);
        for (int64_t v = 0; v < count; ++v) {
            float* out = vertices[v].of;
            for (int k = 0; k < 3; ++k) {
                out[POS + k] = (float)(s.pos[3 * v + k] - s.eye[k]);
                out[COLOR + k] = (float)s.color[3 * v + k];
                out[NORMAL + k] = (float)s.normal[3 * v + k];
                out[SHINE + k] = (float)s.shine[3 * v + k];
            }
            out[HEM] = (float)s.hem[v], out[NEARNESS] = (float)(1.0 / s.depth[v]);
            out[SCREEN] = (float)s.screen[2 * v], out[SCREEN + 1] = (float)s.screen[2 * v + 1];
        }
    }

    // Whether one colour does for both faces: they meet at a vertex, and are seen from the same side.
    bool alike(int32_t one, int32_t other) const {
        const int64_t *a = s.faces + 3 * (int64_t)one, *b = s.faces + 3 * (int64_t)other;
        bool meet = false;
        for (int i = 0; i < 3; ++i) meet |= (a[i] == b[0]) | (a[i] == b[1]) | (a[i] == b[2]);
        return meet && is_turned(a) == is_turned(b);
    }

    void see(const Samples& samples, Sight& out) const {
        const float* corner[3][LANES];
        for (int i = 0; i < LANES; ++i) {
            const int64_t* three = s.faces + 3 * (int64_t)s.face[samples.row[i] * s.width + samples.column[i]];
            for (int k = 0; k < 3; ++k) corner[k][i] = vertices[three[k]].of;
        }
        const auto at = [&](int k, int part) {
            return gather([&](int i) { return corner[k][i][part]; });
        };
        const V x = at(0, SCREEN), y = at(0, SCREEN + 1);
        const V px = real(load(samples.column)) + 0.5f - x, py = real(load(samples.row)) + 0.5f - y;
        const V bx = at(1, SCREEN) - x, by = at(1, SCREEN + 1) - y, cx = at(2, SCREEN) - x, cy = at(2, SCREEN + 1) - y;
        const V turned = bx * cy - by * cx, second = px * cy - py * cx, third = bx * py - by * px;  // times the area
        const V share[3] = {(turned - second - third) * at(0, NEARNESS), second * at(1, NEARNESS), third * at(2, NEARNESS)};
        const V per_whole = 1.0f / (share[0] + share[1] + share[2]);
        float weight[3][LANES];
        for (int k = 0; k < 3; ++k) store(weight[k], clip(share[k] * per_whole, 0.0f, 1.0f));
        for (int i = 0; i < LANES; ++i)
            for (int part = 0; part < VALUES; part += LANES) {
                V mean = weight[0][i] * load(corner[0][i] + part);
                for (int k = 1; k < 3; ++k) mean += weight[k][i] * load(corner[k][i] + part);
                store(out.mean[i].of + part, mean);
            }
        const Three normal = unit(out.parts(NORMAL));
        out.normal = (turned > 0.0f ? all(-1.0f) : all(1.0f)) * normal;
    }

    V nearness(const Samples& samples) const {
        return gather([&](int i) { return s.nearness[samples.row[i] * s.width + samples.column[i]]; });
    }

private:
    bool is_turned(const int64_t* corner) const {
        const float *a = vertices[corner[0]].of + SCREEN, *b = vertices[corner[1]].of + SCREEN, *c = vertices[corner[2]].of + SCREEN;
        return (b[0] - a[0]) * (c[1] - a[1]) > (b[1] - a[1]) * (c[0] - a[0]);
    }
};

// Share of the light from all sides that is not kept off by what is near, and share of the key light that arrives, as in
// hood/media/renderer/shading.py: computed at nodes, of which every block of 2 x 2 pixels has one, and interpolated between those on
// the same surface.
struct Received {
    enum { OPEN = 0, LIT = 1, NODE_NEARNESS = 2, NODE_NORMAL = 3, NODE_VALUES = 6 };  // nearness 0: none
    struct alignas(32) Node {
        float of[NODE_VALUES];
    };
    const Seen& s;
    const Surface& surface;
    const Shadow shadow;
    const int64_t width, height, stride;  // pixels, nodes of a row with one beside it at either end
    std::vector<float>& depths;           // (height, width) m, 0 where the first sample of a pixel sees nothing
    std::vector<Node>& nodes;             // with a row of none above and below

    Received(const Light& light, const Surface& seen, std::vector<float>& depth_memory, std::vector<Node>& memory)
        : s(seen.s), surface(seen), shadow(light, seen.s.eye, 0.9), width(s.width / 2), height(s.height / 2), stride((width + 1) / 2 + 2),
          depths(depth_memory), nodes(memory) {
        const int64_t rows = (height + 1) / 2;
        depths.resize(width * height);
        nodes.assign(stride * (rows + 2), Node{});
        for (int64_t r = 0; r < height; ++r) {
            const float* near = s.nearness + 2 * r * s.width;
            float* out = depths.data() + r * width;
            for (int64_t c = 0; c < width; ++c) out[c] = 1.0f / near[2 * c];  // minus infinity where there is nothing
        }
        Block block;
        for (int64_t i = 0; i < rows; ++i)
            for (int64_t j = 0; j < stride - 2; ++j)
                for (int n = 0; n < 4; ++n) {
                    const int64_t r = 2 * i + n / 2, c = 2 * j + n % 2;
                    if (r >= height || c >= width || depths[r * width + c] == 0.0f) continue;
                    block.add(r, c, (i + 1) * stride + j + 1, (i + j) % 2);
                    if (block.count == LANES) receive(block);
                    break;
                }
        if (block.count) receive(block);
    }

    // At samples with these normals: of light from all sides, and of the key light.
    void arriving(const Samples& samples, V nearness, Three normal, V& open, V& lit) const {
        const Ints r = load(samples.row) >> 1, c = load(samples.column) >> 1;
        const Ints first = ((r >> 1) + 1) * (int32_t)stride + (c >> 1) + 1;
        const Ints down = (r & 1) == 1 ? Ints{} + (int32_t)stride : Ints{} - (int32_t)stride, across = 2 * (c & 1) - 1;
        V total{}, sum_open{}, sum_lit{};
        for (int n = 0; n < 4; ++n) {
            int32_t place[LANES];
            store(place, first + (n / 2 ? down : Ints{}) + (n % 2 ? across : Ints{}));
            const auto part = [&](int k) {
                return gather([&](int i) { return nodes[place[i]].of[k]; });
            };
            const V near = part(NODE_NEARNESS);
            const Three turn = {part(NODE_NORMAL), part(NODE_NORMAL + 1), part(NODE_NORMAL + 2)};
            const Ints other = (magnitude(near - nearness) > 0.005f * nearness) | (dot(turn, normal) < 0.5f);
            const float share = (n / 2 ? 0.25f : 0.75f) * (n % 2 ? 0.25f : 0.75f);
            const V weight = near == 0.0f ? V{} : other ? all(1e-3f * share) : all(share);
            sum_open += weight * part(OPEN);
            sum_lit += weight * part(LIT);
            total += weight;
        }
        open = total > 0.0f ? sum_open / total : all(1.0f);
        lit = total > 0.0f ? sum_lit / total : all(1.0f);
    }

private:
    // Pixels whose nodes are computed together.
    struct Block {
        Samples samples;
        int32_t node[LANES], place[LANES];  // which of Seen::around they look at
        int count = 0;

        void add(int64_t r, int64_t c, int64_t number, int64_t around) {
            samples.row[count] = (int32_t)(2 * r), samples.column[count] = (int32_t)(2 * c);
            node[count] = (int32_t)number, place[count++] = (int32_t)around;
        }
    };

    void receive(Block& block) {
        const int count = block.count;
        while (block.count < LANES) block.add(block.samples.row[0] / 2, block.samples.column[0] / 2, block.node[0], block.place[0]);
        Sight sight;
        surface.see(block.samples, sight);
        float values[NODE_VALUES][LANES];
        store(values[OPEN], open(block, sight.normal));
        store(values[LIT], shadow.lit(sight.parts(POS) + all(0.006f) * sight.normal));
        store(values[NODE_NEARNESS], surface.nearness(block.samples));
        store(values[NODE_NORMAL], sight.normal.x), store(values[NODE_NORMAL + 1], sight.normal.y);
        store(values[NODE_NORMAL + 2], sight.normal.z);
        for (int i = 0; i < count; ++i)
            for (int k = 0; k < NODE_VALUES; ++k) nodes[block.node[i]].of[k] = values[k][i];
        block.count = 0;
    }

    V open(const Block& block, Three normal) const {
        const float focal = (float)(0.5 * s.focal), per_focal = 1.0f / focal, per_reach = (float)(1.0 / (s.reach * s.reach));
        const float across = (float)(0.5 * s.middle[0] - 0.5), up = (float)(0.5 * s.middle[1] - 0.5);
        const V column = real(load(block.samples.column) >> 1), row = real(load(block.samples.row) >> 1);
        const V depth = 1.0f / surface.nearness(block.samples), reach = focal * (float)s.reach / depth;
        const V x = (column - across) * per_focal * depth, y = (up - row) * per_focal * depth;
        const Three n = {dot(every(s.axes), normal), dot(every(s.axes + 3), normal), dot(every(s.axes + 6), normal)};
        const Ints odd = load(block.place) != 0;
        V kept{};
        for (const int64_t ring : {0, 3}) {
            const double *even_offset = s.around + 2 * s.num_around * ring, *odd_offset = s.around + 2 * s.num_around * (ring ? 2 : 1);
            for (int64_t i = 0; i < 2 * s.num_around; i += 2) {
                const auto offset = [&](int64_t k) { return odd ? all((float)odd_offset[i + k]) : all((float)even_offset[i + k]); };
                const V c = rounded_down(column + 0.5f + reach * offset(0)), r = rounded_down(row + 0.5f + reach * offset(1));
                const Ints itself = (c == column) & (r == row);  // rounding alone would stand above it
                const Ints inside = (c >= 0.0f) & (r >= 0.0f) & (c < (float)width) & (r < (float)height) & ~itself;
                int32_t place[LANES];
                store(place, inside & (whole(r) * (int32_t)width + whole(c)));
                const V there = looked_up(depths.data(), place), dz = there - depth;
                const V dx = (c - across) * per_focal * there - x, dy = (up - r) * per_focal * there - y;
                const V dist_sq = dx * dx + dy * dy + dz * dz, far = dist_sq * per_reach, above = n.x * dx + n.y * dy + n.z * dz;
                const Ints keeps = inside & (there != 0.0f) & (far < 1.0f) & (above > 0.0f);
                const V more = higher(above / root(dist_sq) - 0.1f, V{}) * (1.0f - far);
                kept += keeps ? more : V{};
            }
        }
        return clip(1.0f - 1.1f * kept / (float)s.num_around, 0.2f, 1.0f);
    }
};

}  // namespace
