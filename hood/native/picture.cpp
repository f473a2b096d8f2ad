// Pictures: the nearest face of every pixel, and the light on it. The rules are those of hood/media, which stays the reference.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "registers.h"
#include "vector.h"

namespace {

inline double clip(double v, double low, double high) { return std::min(std::max(v, low), high); }
constexpr int64_t TILE = 16;  // pixels of a tile of the shadow map, as in shading.py
constexpr int LANES = REGISTER / 4;  // as many samples as a register holds, 16 at most
typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));
// In float32, for what is drawn.
struct Short {
    float x, y, z;
};
inline Short operator-(Short a) { return {-a.x, -a.y, -a.z}; }
inline Short operator+(Short a, Short b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Short operator*(float s, Short a) { return {s * a.x, s * a.y, s * a.z}; }
inline float dot(Short a, Short b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Short unit(Short a) { return (1.0f / std::sqrt(std::max(dot(a, a), 1e-24f))) * a; }
inline Short brief(const double* p) { return {(float)p[0], (float)p[1], (float)p[2]}; }
inline float clip(float v, float low, float high) { return std::min(std::max(v, low), high); }
inline Vec unit(Vec a) { return (1.0 / std::max(std::sqrt(dot(a, a)), 1e-12)) * a; }

}  // namespace

extern "C" {

// As `LightValues` of hood/media/renderer/raster.py.
struct Light {
    const float* map;      // (size, size) nearness of what the key light sees
    const double* most;    // (tiles, tiles) the most of it from a tile before each tile to one behind
    const double* probes;  // (num_probes, 2) texels
    const double* axes;    // (3, 3) of the key light's view
    int64_t size, num_probes, tiles;
    double low[2];         // m, corner of the map
    double scale, texel;   // texels per m, m
    double key[3], fill[3];
    double key_color[3], fill_color[3], sky_color[3], bounce_color[3];
};

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

// As `FloorValues` of hood/media/renderer/raster.py: what lies behind the surface.
struct Floor {
    const double* dark;  // (cells, cells) shade under low parts
    int64_t width, height, cells;
    double eye[3], right[3], up[3], forward[3], center[3];
    int64_t kind;  // 0: a floor with lines under a sky, 1: one colour, 2: nothing, seen through
    double tan_y, floor, cell;
    double ground[3], horizon[3], zenith[3], plain[3];  // ground and plain linear, the others as shown
};

// best (H, W) starts at -inf, owner (H, W) at -1, each with room for LANES more; of equally near faces the last is drawn. Faces before
// num_closed are those of a surface whose outside alone is seen, which is on the left of its edges.
void picture_rasterise(const double* screen, const double* nearness, const int64_t* faces, int64_t num_faces, int64_t num_closed,
                       int64_t width, int64_t height, double tolerance, double least_area, float* best, int32_t* owner) {
    Floats steps;
    Ints counts;
    for (int i = 0; i < LANES; ++i) steps[i] = (float)i, counts[i] = i;
    for (int64_t f = 0; f < num_faces; ++f) {
        double x[3], y[3], near[3];
        for (int k = 0; k < 3; ++k) {
            const int64_t v = faces[3 * f + k];
            x[k] = screen[2 * v];
            y[k] = screen[2 * v + 1];
            near[k] = nearness[v];
        }
        const double area = (x[1] - x[0]) * (y[2] - y[0]) - (y[1] - y[0]) * (x[2] - x[0]);
        if (!(std::fabs(area) > least_area) || (f < num_closed && area > 0.0)) continue;
        const double top = std::max(std::ceil(std::min(std::min(y[0], y[1]), y[2]) - 0.5), 0.0);
        const double bottom = std::min(std::floor(std::max(std::max(y[0], y[1]), y[2]) - 0.5), height - 1.0);
        const double left = std::max(std::ceil(std::min(std::min(x[0], x[1]), x[2]) - 0.5 - tolerance), 0.0);
        const double right = std::min(std::floor(std::max(std::max(x[0], x[1]), x[2]) - 0.5 + tolerance), width - 1.0);
        if (!(bottom >= top) || !(right >= left)) continue;
        // Barycentric coordinates and nearness as seen from the first sample; a sample is inside where it is less than the tolerance
        // beside an edge along its row.
        const double per_area = 1.0 / area, from_x = left + 0.5, from_y = top + 0.5;
        float slope[3], per_row[3], start[3];
        double along = 0.0, down = 0.0, here = 0.0;
        for (int k = 0; k < 3; ++k) {
            const int n = (k + 1) % 3, p = (k + 2) % 3;
            const double slope_x = (y[n] - y[p]) * per_area, slope_y = (x[p] - x[n]) * per_area;
            const double first = slope_x * (from_x - x[n]) + slope_y * (from_y - y[n]);
            along += slope_x * near[k], down += slope_y * near[k], here += first * near[k];
            slope[k] = (float)slope_x, per_row[k] = (float)slope_y, start[k] = (float)(first + tolerance * std::fabs(slope_x));
        }
        const int64_t first = (int64_t)left, count = (int64_t)right - first + 1;
        const Floats base0 = start[0] + slope[0] * steps, base1 = start[1] + slope[1] * steps, base2 = start[2] + slope[2] * steps;
        const Floats values = (float)here + (float)along * steps;
        const Ints mine = Ints{} + (int32_t)f;
        for (int64_t row = (int64_t)top; row <= (int64_t)bottom; ++row) {
            const float r = (float)(row - (int64_t)top);
            float* near_row = best + row * width + first;
            int32_t* owner_row = owner + row * width + first;
            for (int64_t c = 0; c < count; c += LANES) {
                const float move = (float)c;
                const Floats value = values + ((float)down * r + (float)along * move);
                Floats nearest;
                std::memcpy(&nearest, near_row + c, sizeof nearest);
                const Ints inside = (base0 + (per_row[0] * r + slope[0] * move) >= 0.0f) & (base1 + (per_row[1] * r + slope[1] * move) >= 0.0f) &
                                    (base2 + (per_row[2] * r + slope[2] * move) >= 0.0f) & (value >= nearest) & (counts < (int32_t)(count - c));
                Ints owners;
                std::memcpy(&owners, owner_row + c, sizeof owners);
                nearest = inside ? value : nearest;
                owners = inside ? mine : owners;
                std::memcpy(near_row + c, &nearest, sizeof nearest);
                std::memcpy(owner_row + c, &owners, sizeof owners);
            }
        }
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

}  // extern "C"

namespace {

double lit_at(const Light& light, Vec p, double spread) {
    double seen[3];
    for (int k = 0; k < 3; ++k) seen[k] = dot(at(light.axes, k), p);
    const double across = (seen[0] - light.low[0]) * light.scale + 4.0, down = (seen[1] - light.low[1]) * light.scale + 4.0;
    const double bound = 0.004 + 1.5 * spread * light.texel - seen[2], most = light.size - 1.0, edge = 4.0 * spread;
    if (across < -edge || down < -edge || across > most + edge || down > most + edge) return 1.0;  // the map's rim is empty
    const int64_t tile = (int64_t)clip(down, 0.0, most) / TILE * light.tiles + (int64_t)clip(across, 0.0, most) / TILE;
    if (!(light.most[tile] > bound)) return 1.0;
    int64_t covered = 0;
    for (int64_t i = 0; i < light.num_probes; ++i) {
        const int64_t column = (int64_t)clip(across + spread * light.probes[2 * i], 0.0, most);
        const int64_t row = (int64_t)clip(down + spread * light.probes[2 * i + 1], 0.0, most);
        covered += light.map[row * light.size + column] > bound;
    }
    return 1.0 - (double)covered / light.num_probes;
}

float power_24(float v) {
    const float square = v * v, eighth = square * square * square * square;
    return eighth * eighth * eighth;
}

// Share of the colour left by the hem's edge and its seam, smoothed over the pixel's footprint [m].
float sewn(float dist, float foot) {
    if (dist > 0.03f + foot) return 1.0f;
    const float edge = clip((0.0025f - dist) / foot + 0.5f, 0.0f, 1.0f);
    const float seam = clip((0.0015f - std::fabs(dist - 0.02f)) / foot + 0.5f, 0.0f, 1.0f) * std::min(1.0f, 0.003f / foot);
    return 1.0f - 0.3f * edge - 0.35f * seam;
}

void shade(const Light& light, Short normal, Short view, Short color, Short shines, float lit, float open, float* out) {
    const Short key = brief(light.key);
    const float diffuse = clip((dot(normal, key) + 0.25f) / 1.25f, 0.0f, 1.0f);
    const float shadow = (0.25f + 0.75f * lit) * (0.5f + 0.5f * open);
    const float fill = clip(dot(normal, brief(light.fill)), 0.0f, 1.0f);
    const float up = 0.5f + 0.5f * normal.y, facing = clip(dot(normal, view), 0.0f, 1.0f);
    const float broad = power_24(clip(dot(normal, unit(view + key)), 0.0f, 1.0f)), squared = broad * broad;
    const float gloss = (shines.x * broad + shines.y * squared * squared) * shadow;
    const float away = 1.0f - facing, shine = gloss + shines.z * away * away * away * up, dim = 0.72f + 0.28f * facing;
    const float own[3] = {color.x, color.y, color.z};
    for (int k = 0; k < 3; ++k) {
        const float around = fill * (float)light.fill_color[k] + up * (float)light.sky_color[k] + (1.0f - up) * (float)light.bounce_color[k];
        const float received = diffuse * shadow * (float)light.key_color[k] + open * around;
        out[k] = own[k] * received * dim + shine;
    }
}

// What is known of a vertex, in a cache line: its place from the eye, colour, normal, shine, distance from the hem, 1/depth, place on
// screen; and the same between vertices.
enum { POS = 0, COLOR = 3, NORMAL = 6, SHINE = 9, HEM = 12, NEARNESS = 13, SCREEN = 14 };
struct Values {
    float of[16];
    Short part(int first) const { return {of[first], of[first + 1], of[first + 2]}; }
};

struct Surface {
    const Seen& s;
    std::vector<Values>& vertices;

    Surface(const Seen& seen, int64_t count, std::vector<Values>& memory) : s(seen), vertices(memory) {
        vertices.resize(count);
        for (int64_t v = 0; v < count; ++v) {
            float* out = vertices[v].of;
            const Vec pos = at(s.pos, v) - at(s.eye, 0);
            out[POS] = (float)pos.x, out[POS + 1] = (float)pos.y, out[POS + 2] = (float)pos.z;
            for (int k = 0; k < 3; ++k) {
                out[COLOR + k] = (float)s.color[3 * v + k];
                out[NORMAL + k] = (float)s.normal[3 * v + k];
                out[SHINE + k] = (float)s.shine[3 * v + k];
            }
            out[HEM] = (float)s.hem[v], out[NEARNESS] = (float)(1.0 / s.depth[v]);
            out[SCREEN] = (float)s.screen[2 * v], out[SCREEN + 1] = (float)s.screen[2 * v + 1];
        }
    }
    const float* vertex(int64_t number) const { return vertices[number].of; }

    bool is_turned(const int64_t* corner) const {
        const float *a = vertex(corner[0]) + SCREEN, *b = vertex(corner[1]) + SCREEN, *c = vertex(corner[2]) + SCREEN;
        return (b[0] - a[0]) * (c[1] - a[1]) > (b[1] - a[1]) * (c[0] - a[0]);
    }

    // Whether one colour does for both faces: they meet at a vertex, and are seen from the same side.
    bool alike(int32_t one, int32_t other) const {
        if (one == other) return true;
        const int64_t *a = s.faces + 3 * (int64_t)one, *b = s.faces + 3 * (int64_t)other;
        bool meet = false;
        for (int i = 0; i < 3; ++i) meet |= a[i] == b[0] || a[i] == b[1] || a[i] == b[2];
        return meet && is_turned(a) == is_turned(b);
    }

    // What a sample sees of a face, its unit normal towards the eye.
    Values seen(int64_t row, int64_t column, Short& normal) const {
        const int64_t* corner = s.faces + 3 * (int64_t)s.face[row * s.width + column];
        const float *a = vertex(corner[0]), *b = vertex(corner[1]), *c = vertex(corner[2]);
        const float px = column + 0.5f - a[SCREEN], py = row + 0.5f - a[SCREEN + 1];
        const float bx = b[SCREEN] - a[SCREEN], by = b[SCREEN + 1] - a[SCREEN + 1];
        const float cx = c[SCREEN] - a[SCREEN], cy = c[SCREEN + 1] - a[SCREEN + 1];
        const float turned = bx * cy - by * cx, second = px * cy - py * cx, third = bx * py - by * px;  // times the area
        float weight[3] = {(turned - second - third) * a[NEARNESS], second * b[NEARNESS], third * c[NEARNESS]};
        const float whole = 1.0f / (weight[0] + weight[1] + weight[2]);
        for (float& w : weight) w = std::min(std::max(w * whole, 0.0f), 1.0f);
        Values mean;
        for (int i = 0; i < 16; ++i) mean.of[i] = weight[0] * a[i] + weight[1] * b[i] + weight[2] * c[i];
        normal = unit(mean.part(NORMAL));
        if (turned > 0) normal = -normal;
        return mean;
    }
};

// Share of the light from all sides that is not kept off by what is near, and share of the key light that arrives, as in
// hood/media/renderer/shading.py: computed at nodes, of which every block of 2 x 2 pixels has one, and interpolated between those on
// the same surface.
struct Received {
    struct Node {
        float open, lit, nearness;  // nearness 0: none
        Short normal;
    };
    const Seen& s;
    const int64_t width, height, columns, rows;  // pixels, nodes
    std::vector<float>& depths;                  // (height, width) m, 0 where the first sample of a pixel sees nothing
    std::vector<Node>& nodes;

    Received(const Light& light, const Seen& seen, const Surface& surface, std::vector<float>& depth_memory, std::vector<Node>& memory)
        : s(seen), width(seen.width / 2), height(seen.height / 2), columns((width + 1) / 2), rows((height + 1) / 2),
          depths(depth_memory), nodes(memory) {
        depths.resize(width * height);
        nodes.assign(columns * rows, Node{1.0f, 1.0f, 0.0f, {0.0f, 0.0f, 0.0f}});
        for (int64_t r = 0; r < height; ++r) {
            const float* near = s.nearness + 2 * r * s.width;
            float* out = depths.data() + r * width;
            for (int64_t c = 0; c < width; ++c) out[c] = 1.0f / near[2 * c];  // minus infinity where there is nothing
        }
        for (int64_t i = 0; i < rows; ++i)
            for (int64_t j = 0; j < columns; ++j)
                for (int n = 0; n < 4; ++n) {
                    const int64_t r = 2 * i + n / 2, c = 2 * j + n % 2;
                    if (r >= height || c >= width || depths[r * width + c] == 0.0f) continue;
                    Short normal;
                    const Short from_eye = surface.seen(2 * r, 2 * c, normal).part(POS);
                    const Vec pos = {s.eye[0] + from_eye.x, s.eye[1] + from_eye.y, s.eye[2] + from_eye.z};
                    const float lit = (float)lit_at(light, pos + 0.006 * Vec{normal.x, normal.y, normal.z}, 0.9);
                    nodes[i * columns + j] = {open(r, c, (i + j) % 2, normal), lit, 1.0f / depths[r * width + c], normal};
                    break;
                }
    }

    float open(int64_t row, int64_t column, int64_t place, Short normal) const {
        const float focal = (float)(0.5 * s.focal), per_focal = 1.0f / focal, per_reach = (float)(1.0 / (s.reach * s.reach));
        const float across = (float)(0.5 * s.middle[0] - 0.5), up = (float)(0.5 * s.middle[1] - 0.5), depth = depths[row * width + column];
        const float x = (column - across) * per_focal * depth, y = (up - row) * per_focal * depth;
        const float n[3] = {dot(brief(s.axes), normal), dot(brief(s.axes + 3), normal), dot(brief(s.axes + 6), normal)};
        const float reach = focal * (float)s.reach / depth;
        float kept = 0.0f;
        for (const int64_t ring : {place, 3 - place}) {
            const double* offset = s.around + 2 * s.num_around * ring;
            for (const double* end = offset + 2 * s.num_around; offset < end; offset += 2) {
                const int64_t c = (int64_t)std::floor(column + 0.5f + reach * (float)offset[0]);
                const int64_t r = (int64_t)std::floor(row + 0.5f + reach * (float)offset[1]);
                if (c < 0 || r < 0 || c >= width || r >= height) continue;
                const float there = depths[r * width + c], dz = there - depth;
                const float dx = (c - across) * per_focal * there - x, dy = (up - r) * per_focal * there - y;
                const float dist_sq = dx * dx + dy * dy + dz * dz, far = dist_sq * per_reach, above = n[0] * dx + n[1] * dy + n[2] * dz;
                if (there == 0.0f || far >= 1.0f || !(above > 0.0f)) continue;
                kept += std::max(above / std::sqrt(dist_sq) - 0.1f, 0.0f) * (1.0f - far);
            }
        }
        return std::min(std::max(1.0f - 1.1f * kept / s.num_around, 0.2f), 1.0f);
    }

    // At a sample with this nearness and normal: of light from all sides, and of the key light.
    void at_sample(int64_t row, int64_t column, float nearness, Short normal, float& open, float& lit) const {
        const int64_t r = row / 2, c = column / 2, i = r / 2, j = c / 2;
        const int64_t other_i = r % 2 ? i + 1 : i - 1, other_j = c % 2 ? j + 1 : j - 1;
        float total = 0.0f;
        open = lit = 0.0f;
        for (int n = 0; n < 4; ++n) {
            const int64_t ni = n / 2 ? other_i : i, nj = n % 2 ? other_j : j;
            if (ni < 0 || nj < 0 || ni >= rows || nj >= columns) continue;
            const Node& node = nodes[ni * columns + nj];
            if (node.nearness == 0.0f) continue;
            const bool other = (std::fabs(node.nearness - nearness) > 0.005f * nearness) | (dot(node.normal, normal) < 0.5f);
            const float weight = (n / 2 ? 0.25f : 0.75f) * (n % 2 ? 0.25f : 0.75f) * (other ? 1e-3f : 1.0f);
            open += weight * node.open, lit += weight * node.lit, total += weight;
        }
        open = total > 0.0f ? open / total : 1.0f;
        lit = total > 0.0f ? lit / total : 1.0f;
    }
};

// Colour of a sample that sees a face, from either side.
void shade_sample(const Light& light, const Seen& seen, const Surface& surface, const Received& received, int64_t row, int64_t column,
                  float* out) {
    const int64_t sample = row * seen.width + column;
    Short normal;
    const Values there = surface.seen(row, column, normal);
    Short color = there.part(COLOR);
    if (seen.own && !std::isnan(seen.own[3 * sample])) color = brief(seen.own + 3 * sample);
    color = sewn(there.of[HEM], 1.0f / ((float)seen.focal * seen.nearness[sample])) * color;
    float open, lit;
    received.at_sample(row, column, seen.nearness[sample], normal, open, lit);
    shade(light, normal, unit(-there.part(POS)), color, there.part(SHINE), lit, open, out);
}

}  // namespace

extern "C" {

// Share of the key light at points (P, 3) that is not in shadow.
void picture_lit(const Light* light, const double* points, int64_t count, double spread, double* out) {
    for (int64_t i = 0; i < count; ++i) out[i] = lit_at(*light, at(points, i), spread);
}

}  // extern "C"

namespace {

// Bilinear; the border is repeated.
double sample(const Floor& f, double row, double column) {
    const double most = f.cells - 1.001;
    row = clip(row, 0.0, most);
    column = clip(column, 0.0, most);
    const int64_t r = (int64_t)row, c = (int64_t)column;
    const double down = row - r, across = column - c;
    const double* at = f.dark + r * f.cells + c;
    const double upper = at[0] * (1 - across) + at[1] * across;
    const double lower = at[f.cells] * (1 - across) + at[f.cells + 1] * across;
    return upper * (1 - down) + lower * down;
}

// Linear colours of the sky by how high a ray goes, 0 to 1: between the entries it is straight to 1e-7.
struct Sky {
    static constexpr int STEPS = 1024;
    double color[STEPS + 2][3];

    explicit Sky(const Floor& f) {
        for (int i = 0; i < STEPS + 2; ++i)
            for (int k = 0; k < 3; ++k) color[i][k] = std::pow(f.horizon[k] + (f.zenith[k] - f.horizon[k]) * i / STEPS, 2.2);
    }
    void at(double high, double* out) const {
        const int i = (int)(STEPS * high);
        const double share = STEPS * high - i;
        for (int k = 0; k < 3; ++k) out[k] = color[i][k] + share * (color[i + 1][k] - color[i][k]);
    }
};

constexpr int64_t ACROSS = 4, DOWN = 2;  // pixels from a node of the background to the next one, as in shading.py

// The numbers 0 to 255 by which linear colours are shown, and the colours of the numbers.
struct Shown {
    static constexpr int STEPS = 32768, ROOTS = 1024;
    uint8_t number[STEPS + 1];
    float color[256], unrounded[ROOTS + 2];  // by the root of a colour

    Shown() {
        for (int i = 0; i <= STEPS; ++i) number[i] = (uint8_t)(255.0 * std::pow((double)i / STEPS, 1.0 / 2.2) + 0.5);
        for (int i = 0; i < 256; ++i) color[i] = (float)std::pow(i / 255.0, 2.2);
        for (int i = 0; i < ROOTS + 2; ++i) unrounded[i] = (float)(255.0 * std::pow((double)i / ROOTS, 2.0 / 2.2));
    }
    uint8_t operator()(float linear) const { return number[(int)(STEPS * clip(linear, 0.0f, 1.0f) + 0.5f)]; }
    float exact(double linear) const {
        const float root = ROOTS * std::sqrt(clip((float)linear, 0.0f, 1.0f));
        const int step = (int)root;
        return unrounded[step] + (root - step) * (unrounded[step + 1] - unrounded[step]);
    }
};
const Shown shown;

// What is behind the surface: the floor, which fades into a plain background. All but its lines is computed at nodes, and
// interpolated between them, as it is shown.
struct Background {
    const Light& light;
    const Floor& f;
    const Sky sky;
    const int64_t nodes, wide;
    std::vector<float> above, below;  // (6, nodes) of two rows: colours without lines, and what full lines change
    std::vector<float> row_values;    // (6, wide) of a row of pixels
    int64_t upper = -1;

    Background(const Light& l, const Floor& floor)
        : light(l), f(floor), sky(floor), nodes(floor.width / ACROSS + 2), wide(ACROSS * nodes), above(6 * nodes), below(6 * nodes),
          row_values(6 * wide) {}

    double ray_x(double column) const { return (column + 0.5 - 0.5 * f.width) * f.tan_y / (0.5 * f.height); }
    double ray_y(double row) const { return (0.5 * f.height - row - 0.5) * f.tan_y / (0.5 * f.height); }
    Vec ray(double row, double column) const { return at(f.forward, 0) + ray_x(column) * at(f.right, 0) + ray_y(row) * at(f.up, 0); }

    void node(double row, double column, float* out) const {
        double color[3] = {f.plain[0], f.plain[1], f.plain[2]}, lines = 0.0;
        const Vec r = ray(row, column);
        if (f.kind == 0) sky.at(r.y > 0.0 ? clip(1.6 * r.y / std::sqrt(dot(r, r)), 0.0, 1.0) : 0.0, color);
        const double drop = f.eye[1] - f.floor;
        if (r.y < -1e-4 && drop >= 1e-3) {
            const Vec pos = at(f.eye, 0) + (drop / -r.y) * r;
            const double from_x = pos.x - f.center[0], from_z = pos.z - f.center[2], away_sq = from_x * from_x + from_z * from_z;
            if (!(away_sq > 400.0)) {  // else faded to 1e-17
                const double fade = std::exp(-away_sq * (1.0 / (3.2 * 3.2)));
                const double half = f.cells / 2.0 - 0.5, per_cell = 1.0 / f.cell;
                double left = 1.0 - clip(sample(f, from_z * per_cell + half, from_x * per_cell + half), 0.0, 0.6);
                if (away_sq < 9.0) left *= 0.80 + 0.20 * lit_at(light, pos, 2.5);
                for (int k = 0; k < 3; ++k)
                    color[k] = f.kind == 0 ? fade * f.ground[k] * left + (1.0 - fade) * color[k] : left * color[k];
                if (f.kind == 0) lines = 0.16 * fade * fade * left;
            }
        }
        for (int k = 0; k < 3; ++k) {
            const float bare = shown.exact(color[k]);
            out[k * nodes] = bare;
            out[(3 + k) * nodes] = lines > 1e-4 ? shown.exact(color[k] - lines * f.ground[k]) - bare : 0.0f;
        }
    }

    void node_row(int64_t number, std::vector<float>& out) const {
        const bool low = ray((double)(DOWN * number), 0.0).y < 0.0;
        const int64_t step = low ? 1 : 8;  // the sky changes slowly
        for (int64_t n = 0; n < nodes; n += step) node((double)(DOWN * number), (double)(ACROSS * n), out.data() + n);
        if (low) return;
        if ((nodes - 1) % step != 0) node((double)(DOWN * number), (double)(ACROSS * (nodes - 1)), out.data() + nodes - 1);
        for (int64_t first = 0; first < nodes - 1; first += step) {
            const int64_t last = std::min(first + step, nodes - 1);
            for (int k = 0; k < 6; ++k) {
                float* values = out.data() + k * nodes;
                for (int64_t n = first + 1; n < last; ++n)
                    values[n] = values[first] + (values[last] - values[first]) * (float)(n - first) / (float)(last - first);
            }
        }
    }

    // The numbers (width, 3) of a row of pixels; rows are asked for from the top.
    void show(int64_t row, uint8_t* out) {
        const int64_t number = row / DOWN;
        if (number != upper) {
            if (number == upper + 1 && upper >= 0) above.swap(below);
            else node_row(number, above);
            node_row(number + 1, below);
            upper = number;
        }
        const double steep = ray((double)row, 0.0).y, drop = f.eye[1] - f.floor;  // of the whole row: the camera is upright
        const bool lined = f.kind == 0 && steep < -1e-4 && drop >= 1e-3;
        const float down = (float)(row - DOWN * number) / DOWN;
        for (int k = 0; k < (lined ? 6 : 3); ++k) {
            const float *a = above.data() + k * nodes, *b = below.data() + k * nodes;
            float* values = row_values.data() + k * wide;
            for (int64_t n = 0; n + 1 < nodes; ++n) {
                const float first = a[n] + down * (b[n] - a[n]) + (k < 3 ? 0.5f : 0.0f);  // numbers are rounded
                const float next = a[n + 1] + down * (b[n + 1] - a[n + 1]) + (k < 3 ? 0.5f : 0.0f);
                for (int j = 0; j < ACROSS; ++j) values[ACROSS * n + j] = first + (next - first) * ((float)j / ACROSS);
            }
        }
        if (lined) draw_lines((double)row, drop, steep);
        const float *red = row_values.data(), *green = red + wide, *blue = green + wide;
        for (int64_t c = 0; c < f.width; ++c) out[3 * c] = (uint8_t)red[c], out[3 * c + 1] = (uint8_t)green[c], out[3 * c + 2] = (uint8_t)blue[c];
    }

    // Coverage of 1 cm lines every half metre, smoothed over the pixel's footprint.
    void draw_lines(double row, double drop, double steep) {
        const double reach = drop / -steep;
        const double foot = std::max(reach * 2.0 * f.tan_y / f.height, 1e-4) * std::sqrt(std::max(reach / drop, 1.0));
        const Vec start = at(f.eye, 0) + reach * ray(row, 0.0), step = (reach * (ray_x(1.0) - ray_x(0.0))) * at(f.right, 0);
        const float per_foot = (float)(1.0 / foot), thin = (float)std::min(1.0, 0.01 / foot);
        const auto turns = [](double v) { return (float)(v / 0.5 + 0.5 - std::floor(v / 0.5 + 0.5)); };
        const float x = turns(start.x), z = turns(start.z), dx = (float)(step.x / 0.5), dz = (float)(step.z / 0.5);
        float* values = row_values.data();
        for (int64_t c = 0; c < f.width; ++c) {
            const float along_x = x + dx * c, along_z = z + dz * c;
            const float off_x = std::fabs(along_x - std::floor(along_x) - 0.5f), off_z = std::fabs(along_z - std::floor(along_z) - 0.5f);
            const float cover = (0.005f - 0.5f * std::min(off_x, off_z)) * per_foot + 0.5f;
            const float lines = thin * std::min(std::max(cover, 0.0f), 1.0f);
            values[c] += lines * values[3 * wide + c];
            values[wide + c] += lines * values[4 * wide + c];
            values[2 * wide + c] += lines * values[5 * wide + c];
        }
    }
};

}  // namespace

extern "C" {

// The picture (height, width, 3, or 4 where the background is seen through) of the floor's size: the mean of 2 x 2 samples of what
// is seen, of which those of one surface have the colour of the first; the background where they see nothing.
void picture_draw(const Light* light, const Seen* seen, const Floor* floor, int64_t num_vertices, uint8_t* out) {
    Background behind(*light, *floor);
    const bool clear = floor->kind == 2;
    const int64_t channels = clear ? 4 : 3, wide = floor->width;
    thread_local std::vector<Values> vertices;  // memory that the next picture uses again
    thread_local std::vector<float> depths;
    thread_local std::vector<Received::Node> nodes;
    const Surface surface(*seen, num_vertices, vertices);
    const Received received(*light, *seen, surface, depths, nodes);
    const int64_t first_column = seen->left / 2;
    for (int64_t row = 0; row < floor->height; ++row) {
        uint8_t* pixels = out + channels * wide * row;
        if (clear) {
            std::fill(pixels, pixels + channels * wide, (uint8_t)0);
        } else {
            behind.show(row, pixels);
        }
        const int64_t below = 2 * row - seen->top;
        if (below < 0 || below >= seen->height) continue;
        for (int64_t right = 0; right < seen->width; right += 2) {
            const int32_t *upper = seen->face + below * seen->width + right, *lower = upper + seen->width;
            const int32_t face[4] = {upper[0], upper[1], lower[0], lower[1]};
            if ((face[0] & face[1] & face[2] & face[3]) == -1) continue;
            float sum[3] = {0.0f, 0.0f, 0.0f}, color[4][3];
            int empty = 0, leader[4];
            for (int i = 0; i < 4; ++i) {
                leader[i] = i;
                if (face[i] < 0) {
                    ++empty;
                    continue;
                }
                for (int j = i - 1; j >= 0; --j)
                    if (leader[j] == j && face[j] >= 0 && surface.alike(face[j], face[i])) leader[i] = j;
                if (leader[i] == i) shade_sample(*light, *seen, surface, received, below + i / 2, right + i % 2, color[i]);
                for (int k = 0; k < 3; ++k) sum[k] += color[leader[i]][k];
            }
            const int64_t column = first_column + right / 2;
            uint8_t* pixel = pixels + channels * column;
            const float share = clear ? 1.0f / (4 - empty) : 0.25f;
            for (int k = 0; k < 3; ++k) pixel[k] = shown(share * (sum[k] + (clear || empty == 0 ? 0.0f : empty * shown.color[pixel[k]])));
            if (clear) pixel[3] = (uint8_t)(63.75 * (4 - empty) + 0.5);
        }
    }
}

}  // extern "C"
