// Held vertices of a cloth on their way: whether all reach their targets before cloth meets cloth, and how far they come.
#pragma once
#include <cstdint>
#include <vector>

#include "layers.h"

namespace {

// Held vertices are those that are ``fixed``. The ways begin where all vertices have gone as one body with them.
struct LayerPins {
    Layers& layers;
    const double* target;  // (3 V): of held vertices, and where free ones fly

    static constexpr int ROUNDS = 29, SLOWINGS = 90, HALVINGS = 30;
    static constexpr double SLOWER = 0.7;

    // Targets of held vertices, and ways of free ones.
    void aim(const double* free, double* to) const {
        const size_t size = 3 * layers.fixed.size();
        for (size_t i = 0; i < size; ++i) to[i] = layers.fixed[i / 3] ? target[i] : free[i];
    }

    // Positions ``to`` (3 V) become some that straight ways lead to on which cloth does not meet cloth; whether held vertices are
    // at their targets there.
    bool follow(double left, double* to) {
        const double* from = layers.start.data();
        aim(from, to);
        if (alone_are_free(left, to)) return true;
        layers.restart();
        layers.ahead.assign(to, to + layers.start.size());
        if (layers.go_together(from, to, left, ROUNDS)) return true;
        aim(target, to);
        if (layers.go_together(from, to, left, ROUNDS)) return true;
        stop_short(left, to);
        return layers.overflowed;
    }

    // Whether held vertices meet nothing where the others stay. Those are as far apart as before.
    bool alone_are_free(double left, const double* to) {
        layers.search(layers.start.data(), to, &layers.fixed);
        return layers.overflowed || layers.limit(layers.start.data(), to, left) >= 1.0;
    }

    // Those that cannot make their way lose of it, and stay farther from what they meet than they had to: what is between two of
    // them has to have room.
    void stop_short(double left, double* to) {
        const double* from = layers.start.data();
        const size_t size = layers.fixed.size();
        std::vector<double> shares, own(size, 1.0), shift, count;
        std::vector<int32_t> meeting;
        layers.careful.assign(size, 0);
        aim(from, to);
        for (int round = 0; round < SLOWINGS; ++round) {
            meeting.clear(), shares.clear();
            if (layers.limit(from, to, left, &meeting, &shares) >= 1.0) return;
            if (round >= ROUNDS) slow(meeting, own, to);
            layers.bring_together(meeting, shares, from, to, shift, count);
        }
        const std::vector<double> last(to, to + 3 * size);
        double share = 1.0;
        for (int i = 0; i < HALVINGS && layers.limit(from, to, left) < 1.0; ++i) {
            share = i + 1 < HALVINGS ? 0.5 * share : 0.0;
            for (size_t k = 0; k < 3 * size; ++k) to[k] = from[k] + share * (last[k] - from[k]);
        }
    }

    // Takes their share of the way from held vertices of pairs that meet.
    void slow(const std::vector<int32_t>& meeting, std::vector<double>& own, double* to) {
        const double* from = layers.start.data();
        std::vector<uint8_t> meets(own.size(), 0);
        for (int32_t i : meeting)
            for (int32_t v : layers.pairs[i].corner) meets[v] = layers.careful[v] = 1;
        for (size_t v = 0; v < own.size(); ++v) {
            if (!meets[v] || !layers.fixed[v]) continue;
            own[v] *= SLOWER;
            for (size_t k = 3 * v; k < 3 * v + 3; ++k) to[k] = from[k] + own[v] * (target[k] - from[k]);
        }
    }
};

}  // namespace
