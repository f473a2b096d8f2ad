// What lies behind a surface, and rows of pixels of which those of one place in every four lie together.
#pragma once
#include <algorithm>
#include <vector>

#include "picture_lanes.h"
#include "picture_light.h"

extern "C" {

// As `FloorValues` of hood/media/renderer/raster.py: what lies behind the surface.
struct Floor {
    const double* dark;  // (cells, cells) shade under low parts
    int64_t width, height, cells;
    double eye[3], right[3], up[3], forward[3], center[3];
    int64_t kind;  // 0: a floor with lines under a sky, 1: one colour, 2: nothing, seen through
    double tan_y, floor, cell;
    double ground[3], horizon[3], zenith[3], plain[3];  // ground and plain linear, the others as shown
};
}

namespace {

constexpr int ACROSS = 4, DOWN = 2;  // pixels from a node of the background to the next one, as in shading.py

// The four channels of a row of pixels, before they are rounded down: of every ACROSS pixels the first ones, then the second ones,
// so that they are computed many at a time, and written with the same steps for all.
struct Row {
    const int64_t fours;  // with room for a register
    std::vector<float> values;
    std::vector<int32_t> words;  // to be written

    explicit Row(int64_t width) : fours((width / ACROSS / LANES + 2) * LANES), values(4 * ACROSS * fours) {}

    float* channel(int k, int64_t place) { return values.data() + (k * ACROSS + place) * fours; }

    // Bytes of three or four channels.
    void write(int64_t width, int64_t channels, uint8_t* out) {
        words.resize(channels * fours);
        for (int64_t n = 0; ACROSS * n < width; n += LANES) {
            Ints bytes[ACROSS][4], word[4];
            for (int p = 0; p < ACROSS; ++p)
                for (int k = 0; k < channels; ++k) bytes[p][k] = whole(load(channel(k, p) + n));
            for (int w = 0; w < channels; ++w) {
                word[w] = Ints{};
                for (int b = 0; b < 4; ++b) word[w] |= bytes[(4 * w + b) / channels][(4 * w + b) % channels] << 8 * b;
            }
            int32_t parts[4][LANES];
            for (int w = 0; w < channels; ++w) store(parts[w], word[w]);
            int32_t* to = words.data() + channels * n;
            for (int i = 0; i < LANES; ++i)
                for (int w = 0; w < channels; ++w) *to++ = parts[w][i];
        }
        std::memcpy(out, words.data(), channels * width);
    }
};

// What is behind the surface: the floor, which fades into a plain background. All but its lines is computed at nodes, and
// interpolated between them, as it is shown.
struct Background {
    const Floor& f;
    const Shadow shadow;
    const int64_t nodes;
    const double per_pixel, drop;     // by how much rays differ, m from the eye down to the floor
    std::vector<float> above, below;  // (6, nodes) of two rows: colours without lines, and what full lines change
    int64_t upper = -1;

    Background(const Light& light, const Floor& floor, int64_t fours)
        : f(floor), shadow(light, floor.center, 2.5), nodes(fours + LANES), per_pixel(2.0 * f.tan_y / f.height),
          drop(f.eye[1] - f.floor), above(6 * nodes), below(6 * nodes) {}

    // Rows are asked for from the top.
    void show(int64_t number, Row& row) {
        const int64_t first = number / DOWN;
        if (first != upper) {
            if (first == upper + 1 && upper >= 0) above.swap(below);
            else node_row(first, above);
            node_row(first + 1, below);
            upper = first;
        }
        const double steep = ray(number, 0.0).y;  // of the whole row: the camera is upright
        const Lines lines(*this, number, steep);
        const float down = (float)(number - DOWN * first) / DOWN;
        for (int64_t n = 0; ACROSS * n < f.width; n += LANES) {
            V value[6], step[6];
            for (int k = 0; k < (lines.there ? 6 : 3); ++k) {
                const float *a = above.data() + k * nodes + n, *b = below.data() + k * nodes + n;
                const V next = load(a + 1) + down * (load(b + 1) - load(a + 1));
                value[k] = load(a) + down * (load(b) - load(a));
                step[k] = next - value[k];
                if (k < 3) value[k] += 0.5f;  // numbers are rounded
            }
            for (int p = 0; p < ACROSS; ++p) {
                const float part = (float)p / ACROSS;
                const V cover = lines.there ? lines.cover(ACROSS * (counted() + (float)n) + (float)p) : V{};
                for (int k = 0; k < 3; ++k) {
                    V shown = value[k] + part * step[k];
                    if (lines.there) shown += cover * (value[3 + k] + part * step[3 + k]);
                    store(row.channel(k, p) + n, shown);
                }
            }
        }
    }

private:
    double ray_x(double column) const { return (column + 0.5 - 0.5 * f.width) * per_pixel; }
    double ray_y(double row) const { return (0.5 * f.height - row - 0.5) * per_pixel; }
    Vec ray(double row, double column) const { return at(f.forward, 0) + ray_x(column) * at(f.right, 0) + ray_y(row) * at(f.up, 0); }

    // Coverage of 1 cm lines every half metre, smoothed over the pixel's footprint.
    struct Lines {
        bool there;
        float x, z, dx, dz, per_foot, thin;  // turns of the first pixel and of a step

        Lines(const Background& b, int64_t number, double steep) : there(b.f.kind == 0 && steep < -1e-4 && b.drop >= 1e-3) {
            const double reach = b.drop / -steep;
            const double foot = std::max(reach * b.per_pixel, 1e-4) * std::sqrt(std::max(reach / b.drop, 1.0));
            const Vec start = at(b.f.eye, 0) + reach * b.ray(number, 0.0);
            const auto turns = [](double v) { return (float)(v / 0.5 + 0.5 - std::floor(v / 0.5 + 0.5)); };
            x = turns(start.x), z = turns(start.z);
            dx = (float)(reach * b.per_pixel * b.f.right[0] / 0.5), dz = (float)(reach * b.per_pixel * b.f.right[2] / 0.5);
            per_foot = (float)(1.0 / foot), thin = (float)std::min(1.0, 0.01 / foot);
        }
        V cover(V column) const {
            const V along_x = x + dx * column, along_z = z + dz * column;
            const V off_x = magnitude(along_x - rounded_down(along_x) - 0.5f), off_z = magnitude(along_z - rounded_down(along_z) - 0.5f);
            return thin * clip((0.005f - 0.5f * lower(off_x, off_z)) * per_foot + 0.5f, 0.0f, 1.0f);
        }
    };

    void node_row(int64_t number, std::vector<float>& out) const {
        const Vec first = ray((double)(DOWN * number), 0.0);
        const float step = (float)(ACROSS * per_pixel);
        for (int64_t n = 0; ACROSS * (n - 1) < f.width; n += LANES) {
            const V along = step * (counted() + (float)n);
            const Three r = {(float)first.x + along * (float)f.right[0], (float)first.y + along * (float)f.right[1],
                             (float)first.z + along * (float)f.right[2]};
            V bare[3], change[3] = {};
            far(r, bare);
            if (drop >= 1e-3 && any(r.y < -1e-4f)) near(r, bare, change);
            for (int k = 0; k < 3; ++k) store(out.data() + k * nodes + n, bare[k]), store(out.data() + (3 + k) * nodes + n, change[k]);
        }
    }

    // Numbers 0 to 255 of the sky, or of the one colour.
    void far(Three r, V* bare) const {
        const V high = r.y > 0.0f ? clip(1.6f * r.y / root(dot(r, r)), 0.0f, 1.0f) : V{};
        for (int k = 0; k < 3; ++k) {
            const V sky = 255.0f * ((float)f.horizon[k] + (float)(f.zenith[k] - f.horizon[k]) * high);
            bare[k] = f.kind == 0 ? sky : shown(all((float)f.plain[k]));
        }
    }

    // Those of the floor where rays meet it, and what its lines change.
    void near(Three r, V* bare, V* change) const {
        const V reach = (float)drop / (r.y < -1e-4f ? -r.y : all(1.0f));
        const Three from = {reach * r.x + (float)(f.eye[0] - f.center[0]), all((float)(f.floor - f.center[1])),
                            reach * r.z + (float)(f.eye[2] - f.center[2])};
        const V away_sq = from.x * from.x + from.z * from.z;
        const Ints meets = (r.y < -1e-4f) & (away_sq <= 400.0f);  // else faded to 1e-17
        if (!any(meets)) return;
        const V fade = exponential(higher(away_sq * (float)(-1.44269504088896 / (3.2 * 3.2)), all(-100.0f)));
        V left = 1.0f - clip(shade(from), 0.0f, 0.6f);
        const Ints shadowed = meets & (away_sq < 9.0f);
        if (any(shadowed)) left *= shadowed ? 0.80f + 0.20f * shadow.lit(from) : all(1.0f);
        const V lines = f.kind == 0 ? 0.16f * fade * fade * left : V{};
        const Ints lined = meets & (lines > 1e-4f);
        for (int k = 0; k < 3; ++k) {
            const float ground = (float)f.ground[k], sky = (float)std::pow(f.horizon[k], 2.2);
            const V color = f.kind == 0 ? fade * left * ground + (1.0f - fade) * sky : left * (float)f.plain[k];
            bare[k] = meets ? shown(color) : bare[k];
            if (any(lined)) change[k] = lined ? shown(color - lines * ground) - bare[k] : V{};
        }
    }

    // Shade under low parts, bilinear; the border is repeated.
    V shade(Three from) const {
        const float half = f.cells / 2.0f - 0.5f, per_cell = (float)(1.0 / f.cell), most = f.cells - 1.001f;
        const V row = clip(from.z * per_cell + half, 0.0f, most), column = clip(from.x * per_cell + half, 0.0f, most);
        const Ints r = whole(row), c = whole(column);
        const V down = row - real(r), across = column - real(c);
        int32_t place[LANES];
        store(place, r * (int32_t)f.cells + c);
        const auto along = [&](const double* table) {
            const V first = looked_up(table, place);
            return first + across * (looked_up(table + 1, place) - first);
        };
        const V upper_row = along(f.dark);
        return upper_row + down * (along(f.dark + f.cells) - upper_row);
    }
};

}  // namespace
