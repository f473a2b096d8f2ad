// Pictures: the nearest face of every pixel, and the light on it. The rules are those of hood/media, which stays the reference.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "picture_background.h"
#include "picture_lanes.h"
#include "picture_light.h"
#include "picture_surface.h"
#include "vector.h"

namespace {

inline double clip(double v, double low, double high) { return std::min(std::max(v, low), high); }
inline Vec unit(Vec a) { return (1.0 / std::max(std::sqrt(dot(a, a)), 1e-12)) * a; }

// A face on screen: the samples that may lie in it, barycentric coordinates and nearness at the first one and what a step along a row
// and down a column adds to them. A sample is inside where it is less than the tolerance beside an edge along its row.
struct OnScreen {
    int32_t number;
    int64_t left, right, top, rows;
    float start[3], slope[3], per_row[3], here, along, down;

    // False where no sample lies in it.
    bool place(const double (*pos)[2], const double* near, int64_t width, int64_t height, double tolerance, double per_area) {
        const double *a = pos[0], *b = pos[1], *c = pos[2];
        const double low = std::min(std::min(a[1], b[1]), c[1]), high = std::max(std::max(a[1], b[1]), c[1]);
        const double least = std::min(std::min(a[0], b[0]), c[0]), most = std::max(std::max(a[0], b[0]), c[0]);
        const double first_row = std::max(std::ceil(low - 0.5), 0.0), last_row = std::min(std::floor(high - 0.5), height - 1.0);
        const double first = std::max(std::ceil(least - 0.5 - tolerance), 0.0);
        const double last = std::min(std::floor(most - 0.5 + tolerance), width - 1.0);
        if (!(last_row >= first_row) || !(last >= first)) return false;
        left = (int64_t)first, right = (int64_t)last, top = (int64_t)first_row, rows = (int64_t)last_row - top + 1;
        double sum[3] = {0.0, 0.0, 0.0};
        for (int k = 0; k < 3; ++k) {
            const double *n = pos[(k + 1) % 3], *p = pos[(k + 2) % 3];
            const double slope_x = (n[1] - p[1]) * per_area, slope_y = (p[0] - n[0]) * per_area;
            const double there = slope_x * (first + 0.5 - n[0]) + slope_y * (first_row + 0.5 - n[1]);
            sum[0] += there * near[k], sum[1] += slope_x * near[k], sum[2] += slope_y * near[k];
            start[k] = (float)(there + tolerance * std::fabs(slope_x)), slope[k] = (float)slope_x, per_row[k] = (float)slope_y;
        }
        here = (float)sum[0], along = (float)sum[1], down = (float)sum[2];
        return true;
    }

    // Over what is nearest so far, LANES columns at a time; owner may be null.
    void draw(int64_t width, float* best, int32_t* owner) const {
        for (int64_t c = left; c <= right; c += LANES) {
            const V beside = (float)(c - left) + counted(), value = here + along * beside;
            V base[3];
            for (int k = 0; k < 3; ++k) base[k] = start[k] + slope[k] * beside;
            base[0] = beside <= (float)(right - left) ? base[0] : all(-1e30f);
            V row{};
            for (int64_t at = top * width + c, end = at + rows * width; at < end; at += width, row += 1.0f) {
                const V there = value + down * row, nearest = load(best + at);
                const V inside = lower(lower(base[0] + per_row[0] * row, base[1] + per_row[1] * row), base[2] + per_row[2] * row);
                const Ints mine = (inside >= 0.0f) & (there >= nearest);
                store(best + at, mine ? there : nearest);
                if (owner) store(owner + at, mine ? Ints{} + number : load(owner + at));
            }
        }
    }
};

}  // namespace

extern "C" {

// best (H, W) is -inf and owner (H, W) -1 where nothing is drawn; each has room for LANES more, and owner may be null. Of equally near
// faces the last is drawn. Faces before num_closed are those of a surface whose outside alone is seen, which is on the left of its edges.
void picture_rasterise(const double* screen, const double* nearness, const int64_t* faces, int64_t num_faces, int64_t num_closed,
                       int64_t width, int64_t height, double tolerance, double least_area, float* best, int32_t* owner) {
    std::fill(best, best + width * height, -INFINITY);
    if (owner) std::fill(owner, owner + width * height, -1);
    for (int64_t f = 0; f < num_faces; ++f) {
        double pos[3][2], near[3];
        for (int k = 0; k < 3; ++k) {
            const int64_t v = faces[3 * f + k];
            pos[k][0] = screen[2 * v], pos[k][1] = screen[2 * v + 1], near[k] = nearness[v];
        }
        const double area = (pos[1][0] - pos[0][0]) * (pos[2][1] - pos[0][1]) - (pos[1][1] - pos[0][1]) * (pos[2][0] - pos[0][0]);
        if (!(std::fabs(area) > least_area) || (f < num_closed && area > 0.0)) continue;
        OnScreen face;
        face.number = (int32_t)f;
        if (face.place(pos, near, width, height, tolerance, 1.0 / area)) face.draw(width, best, owner);
    }
}

// Unit normals (V, 3) of vertices, zero at the start: of faces by their areas.
void picture_normals(const double* pos, const int64_t* faces, int64_t num_faces, int64_t num_vertices, double* out) {
    for (int64_t f = 0; f < num_faces; ++f) {
        const int64_t* corner = faces + 3 * f;
        const Vec a = at(pos, corner[0]), normal = cross(at(pos, corner[1]) - a, at(pos, corner[2]) - a);
        for (int k = 0; k < 3; ++k) {
            double* sum = out + 3 * corner[k];
            sum[0] += normal.x, sum[1] += normal.y, sum[2] += normal.z;
        }
    }
    for (int64_t v = 0; v < num_vertices; ++v) {
        const Vec normal = unit(at(out, v));
        out[3 * v] = normal.x, out[3 * v + 1] = normal.y, out[3 * v + 2] = normal.z;
    }
}

// Faces (F, 3) with their own vertices where the mean normal of a vertex is not theirs: those vertices, and their normals, with room
// for one a corner. Returns how many.
int64_t picture_creased(const double* pos, const double* normal, int64_t num_faces, int64_t num_vertices, double crease, int64_t* faces,
                        int64_t* vertex, double* own) {
    std::vector<Vec> flat(num_faces);
    std::vector<int64_t> off;
    for (int64_t f = 0; f < num_faces; ++f) {
        const Vec a = at(pos, faces[3 * f]);
        const Vec n = flat[f] = unit(cross(at(pos, faces[3 * f + 1]) - a, at(pos, faces[3 * f + 2]) - a));
        if (!(std::fabs(n.x) + std::fabs(n.y) + std::fabs(n.z) > 0.5)) continue;
        for (int k = 0; k < 3; ++k)
            if (dot(n, at(normal, faces[3 * f + k])) < crease) off.push_back(3 * f + k);
    }
    if (off.empty()) return 0;
    std::vector<int64_t> end(num_vertices + 1, 0), around(3 * num_faces);
    for (int64_t i = 0; i < 3 * num_faces; ++i) ++end[faces[i] + 1];
    for (int64_t v = 0; v < num_vertices; ++v) end[v + 1] += end[v];
    std::vector<int64_t> next(end.begin(), end.end() - 1);
    for (int64_t i = 0; i < 3 * num_faces; ++i) around[next[faces[i]]++] = i / 3;
    for (size_t i = 0; i < off.size(); ++i) {
        const int64_t v = vertex[i] = faces[off[i]];
        Vec sum{0, 0, 0};
        for (int64_t j = end[v]; j < end[v + 1]; ++j)
            if (dot(flat[around[j]], flat[off[i] / 3]) > 0.5) sum = sum + flat[around[j]];
        const Vec n = unit(sum);
        own[3 * i] = n.x, own[3 * i + 1] = n.y, own[3 * i + 2] = n.z;
    }
    for (size_t i = 0; i < off.size(); ++i) faces[off[i]] = num_vertices + (int64_t)i;
    return (int64_t)off.size();
}

// Shade of faces on the floor below them, by cells (cells, cells) of z and x about the middle, zero at the start.
void picture_low(const double* pos, const int64_t* faces, int64_t num_faces, const double* middle, double floor, double cell, int64_t cells,
                 double* out) {
    for (int64_t f = 0; f < num_faces; ++f) {
        const Vec a = at(pos, faces[3 * f]), b = at(pos, faces[3 * f + 1]), c = at(pos, faces[3 * f + 2]);
        const Vec there = 1.0 / 3.0 * (a + b + c);
        const double share = std::fabs(cross(b - a, c - a).y) * std::exp(-std::max(there.y - floor, 0.0) / 0.12);
        const auto place = [&](double v) { return (int64_t)clip(v / cell + cells / 2, 0.0, cells - 1.0); };
        out[place(there.z - middle[2]) * cells + place(there.x - middle[0])] += 0.25 / (cell * cell) * share;
    }
}

// The most of a map (size, size) in every tile: (size / TILE, size / TILE), minus infinity at the start.
void picture_most(const float* map, int64_t size, double* out) {
    const int64_t tiles = size / TILE;
    for (int64_t row = 0; row < size; ++row)
        for (int64_t tile = 0; tile < tiles; ++tile) {
            const float* first = map + row * size + TILE * tile;
            float most = (float)out[row / TILE * tiles + tile];
            for (int i = 0; i < TILE; ++i) most = first[i] > most ? first[i] : most;
            out[row / TILE * tiles + tile] = most;
        }
}

// Share of the key light at points (P, 3) that is not in shadow.
void picture_lit(const Light* light, const double* points, int64_t count, double spread, double* out) {
    if (count == 0) return;
    const Shadow shadow(*light, points, spread);
    for (int64_t first = 0; first < count; first += LANES) {
        const auto axis = [&](int k) {
            return gather([&](int i) { return (float)(points[3 * std::min(first + i, count - 1) + k] - points[k]); });
        };
        float lit[LANES];
        store(lit, shadow.lit({axis(0), axis(1), axis(2)}));
        for (int64_t i = first; i < std::min(first + LANES, count); ++i) out[i] = lit[i - first];
    }
}

}  // extern "C"

namespace {

// Linear colours of the numbers 0 to 255.
struct Linear {
    float of[256];

    Linear() {
        for (int i = 0; i < 256; ++i) of[i] = (float)std::pow(i / 255.0, 2.2);
    }
};
const Linear linear;

// Pixels of a row that see a surface: the mean of 2 x 2 samples, of which those of one surface have the colour of the first.
struct Pixels {
    const Light& light;
    const Seen& seen;
    const Surface& surface;
    const Received& received;
    const bool clear;  // whether nothing is behind the surface
    Row sums;          // linear, and 255 shares of the pixel that are covered
    Samples samples;
    int64_t pixel[LANES];  // of each sample, in a channel of a row
    float share[LANES];
    int count = 0;

    Pixels(const Light& l, const Surface& s, const Received& r, bool c, int64_t width)
        : light(l), seen(s.s), surface(s), received(r), clear(c), sums(width) {}

    // Over the row of the picture, whose first samples are in this row.
    void draw(int64_t below, Row& row) {
        std::fill(sums.values.begin(), sums.values.end(), 0.0f);
        float* covered = sums.channel(3, 0);
        const int32_t *upper = seen.face + below * seen.width, *lower = upper + seen.width;
        for (int64_t right = 0; right < seen.width; right += 2) {
            const int32_t face[4] = {upper[right], upper[right + 1], lower[right], lower[right + 1]};
            if ((face[0] & face[1] & face[2] & face[3]) == -1) continue;
            const uint64_t column = (uint64_t)(seen.left + right) / 2, place = column % ACROSS * row.fours + column / ACROSS;
            if (((face[0] ^ face[1]) | (face[0] ^ face[2]) | (face[0] ^ face[3])) == 0) {
                covered[place] = 255.0f;
                add(below, right, place, 1.0f);
            } else {
                covered[place] = 63.75f * list(below, right, face, place, row);
            }
        }
        if (count) light_samples();
        show(row);
    }

private:
    // How many samples of a pixel see something.
    int list(int64_t below, int64_t right, const int32_t* face, int64_t place, Row& row) {
        int covered = 0, leader[4], led[4] = {0, 0, 0, 0};  // which sample has the colour, and how many have that of this one
        for (int i = 0; i < 4; ++i) {
            leader[i] = i;
            if (face[i] < 0) continue;
            for (int j = 0; j < i && leader[i] == i; ++j) {
                if (face[j] == face[i]) leader[i] = leader[j];
                else if (face[j] >= 0 && leader[j] == j && surface.alike(face[j], face[i])) leader[i] = j;
            }
            ++led[leader[i]], ++covered;
        }
        if (covered < 4 && !clear)
            for (int k = 0; k < 3; ++k) sums.channel(k, 0)[place] = 0.25f * (4 - covered) * linear.of[(int)row.channel(k, 0)[place]];
        const float each = clear ? 1.0f / covered : 0.25f;
        for (int i = 0; i < 4; ++i)
            if (led[i]) add(below + i / 2, right + i % 2, place, each * led[i]);
        return covered;
    }

    void add(int64_t row, int64_t column, int64_t place, float part) {
        samples.row[count] = (int32_t)row, samples.column[count] = (int32_t)column;
        pixel[count] = place, share[count] = part;
        if (++count == LANES) light_samples();
    }

    void light_samples() {
        for (int i = count; i < LANES; ++i) samples.row[i] = samples.row[0], samples.column[i] = samples.column[0];
        Sight sight;
        surface.see(samples, sight);
        const V nearness = surface.nearness(samples);
        V open, lit;
        received.arriving(samples, nearness, sight.normal, open, lit);
        const Three own = seen.own ? printed(sight.parts(COLOR)) : sight.parts(COLOR);
        const Three color = sewn(sight.part(HEM), 1.0f / ((float)seen.focal * nearness)) * own;
        const Three out = shade(light, sight.normal, unit(all(-1.0f) * sight.parts(POS)), color, sight.parts(SHINE), lit, open);
        float values[3][LANES];
        store(values[0], out.x), store(values[1], out.y), store(values[2], out.z);
        for (int i = 0; i < count; ++i)
            for (int k = 0; k < 3; ++k) sums.channel(k, 0)[pixel[i]] += share[i] * values[k][i];
        count = 0;
    }

    // The colours of images where samples have one.
    Three printed(Three color) const {
        const auto channel = [&](V plain, int k) {
            const V found = gather([&](int i) { return (float)seen.own[3 * (samples.row[i] * seen.width + samples.column[i]) + k]; });
            return found == found ? found : plain;
        };
        return {channel(color.x, 0), channel(color.y, 1), channel(color.z, 2)};
    }

    void show(Row& row) {
        const int64_t first = seen.left / 2 / ACROSS / LANES * LANES, last = (seen.left + seen.width) / 2 / ACROSS;
        for (int p = 0; p < ACROSS; ++p)
            for (int64_t n = first; n <= last; n += LANES) {
                const Ints mine = load(sums.channel(3, p) + n) > 0.0f;
                if (!any(mine)) continue;
                for (int k = 0; k < (clear ? 4 : 3); ++k) {
                    const V sum = load(sums.channel(k, p) + n);
                    float* value = row.channel(k, p) + n;
                    store(value, mine ? (k < 3 ? shown(sum) : sum) + 0.5f : load(value));
                }
            }
    }
};

}  // namespace

extern "C" {

// The picture (height, width, 3, or 4 where the background is seen through) of the floor's size, in rows so many bytes apart.
void picture_draw(const Light* light, const Seen* seen, const Floor* floor, int64_t num_vertices, int64_t apart, uint8_t* out) {
    const bool clear = floor->kind == 2;
    const int64_t channels = clear ? 4 : 3;
    thread_local std::vector<Values> vertices;  // memory that the next picture uses again
    thread_local std::vector<float> depths;
    thread_local std::vector<Received::Node> nodes;
    const Surface surface(*seen, num_vertices, vertices);
    const Received received(*light, surface, depths, nodes);
    Row row(floor->width);
    Background behind(*light, *floor, row.fours);
    Pixels pixels(*light, surface, received, clear, floor->width);
    for (int64_t number = 0; number < floor->height; ++number) {
        if (clear) {
            std::fill(row.values.begin(), row.values.end(), 0.0f);
        } else {
            behind.show(number, row);
        }
        const int64_t below = 2 * number - seen->top;
        if (below >= 0 && below < seen->height) pixels.draw(below, row);
        row.write(floor->width, channels, out + apart * number);
    }
}

}  // extern "C"
