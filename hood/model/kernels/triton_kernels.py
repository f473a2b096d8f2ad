"""The kernels behind :mod:`hood.model.kernels.triton_step`; importing this module needs Triton.

No annotations from the future here: Triton reads the annotations of a kernel's constants.
"""
# mypy: disable-error-code="no-untyped-def, misc"

import triton
import triton.language as tl


@triton.jit
def dot(left, right, PRECISION: tl.constexpr, WIDEN: tl.constexpr):
    """left right, summed in float32. WIDEN: bfloat16 as float32, for Triton's interpreter, whose product has none."""
    if WIDEN:
        left, right = left.to(tl.float32), right.to(tl.float32)
    return tl.dot(left, right, input_precision=PRECISION)


@triton.jit
def layer_of(x, pointer, stride, columns, present, PRECISION: tl.constexpr, WIDEN: tl.constexpr):
    """x Wᵀ for a layer's weights W (out, in), rounded to the precision of ``x``; columns not present are zero."""
    mask = present[:, None] & present[None, :]
    weight = tl.load(pointer + columns[None, :] * stride + columns[:, None], mask=mask, other=0.0).to(x.dtype)
    return dot(x, weight, PRECISION, WIDEN)


@triton.jit
def vector_of(pointer, columns, present):
    """A layer's bias, or scale or shift of its norm, in float32."""
    return tl.load(pointer + columns, mask=present, other=0.0).to(tl.float32)


@triton.jit
def _tail(
    hidden,
    weight_2,
    bias_2,
    weight_3,
    bias_3,
    scale,
    shift,
    columns,
    present,
    eps,
    dtype,
    PRECISION: tl.constexpr,
    WIDEN: tl.constexpr,
    WIDTH: tl.constexpr,
):
    """The network behind its first layer, the layer norm included, in float32; ``hidden`` in float32, before its ReLU."""
    hidden = tl.maximum(hidden, 0.0).to(dtype)
    hidden = layer_of(hidden, weight_2, WIDTH, columns, present, PRECISION, WIDEN)
    hidden = tl.maximum(hidden + vector_of(bias_2, columns, present)[None, :], 0.0).to(dtype)
    raw = layer_of(hidden, weight_3, WIDTH, columns, present, PRECISION, WIDEN)
    raw += vector_of(bias_3, columns, present)[None, :]
    centred = tl.where(present[None, :], raw - (tl.sum(raw, axis=1) / WIDTH)[:, None], 0.0)
    variance = tl.sum(centred * centred, axis=1) / WIDTH
    out = centred * (1.0 / tl.sqrt(variance + eps))[:, None] * vector_of(scale, columns, present)[None, :]
    return out + vector_of(shift, columns, present)[None, :]


@triton.jit
def edges_pass(
    latent,
    tables,
    stride,
    column,
    receivers,
    senders,
    local_receivers,
    chosen,
    weight_1,
    stride_1,
    weight_2,
    bias_2,
    weight_3,
    bias_3,
    scale,
    shift,
    received,
    borders,
    count,
    tiles,
    eps,
    PRECISION: tl.constexpr,
    WIDEN: tl.constexpr,
    WIDTH: tl.constexpr,
    PADDED: tl.constexpr,
    TILE: tl.constexpr,
    SOME: tl.constexpr,
):
    """New latents of TILE edges; sums at the nodes of which the tile holds all edges; partial sums at its two ends."""
    tile = tl.program_id(0)
    rows = tile * TILE + tl.arange(0, TILE)
    inside = rows < count
    columns = tl.arange(0, PADDED)
    present = columns < WIDTH
    both = inside[:, None] & present[None, :]
    if SOME:
        owned = tl.load(chosen + rows, mask=inside, other=0).to(tl.int64)
    else:
        owned = rows.to(tl.int64)
    places = owned[:, None] * WIDTH + columns[None, :]
    dtype = latent.dtype.element_ty

    node = tl.load(receivers + rows, mask=inside, other=0).to(tl.int64)
    sender = tl.load(senders + rows, mask=inside, other=0).to(tl.int64)
    edge = tl.load(latent + places, mask=both, other=0.0)
    at_ends = tables + column + columns[None, :]
    hidden = tl.load(at_ends + node[:, None] * stride, mask=both, other=0.0).to(tl.float32)
    hidden += tl.load(at_ends + WIDTH + sender[:, None] * stride, mask=both, other=0.0).to(tl.float32)
    hidden += layer_of(edge, weight_1, stride_1, columns, present, PRECISION, WIDEN)
    rest = (weight_2, bias_2, weight_3, bias_3, scale, shift)
    message = _tail(hidden, *rest, columns, present, eps, dtype, PRECISION, WIDEN, WIDTH)
    tl.store(latent + places, (edge.to(tl.float32) + message).to(dtype), mask=both)

    # Row i of the sums is that of all edges of the tile with the receiver of edge i: a product with a matrix of 0 and 1.
    receiver = tl.load(local_receivers + rows, mask=inside, other=-1)
    same = (receiver[:, None] == tl.load(local_receivers + rows, mask=inside, other=-2)[None, :]).to(tl.float32).to(dtype)
    sums = dot(same, message.to(dtype), PRECISION, WIDEN)
    before = tl.load(local_receivers + rows - 1, mask=inside & (rows > 0), other=-1)
    stop = tl.minimum((tile + 1) * TILE, count)
    last = tl.load(local_receivers + stop - 1)
    after = tl.load(local_receivers + stop, mask=stop < count, other=-1)
    unfinished = tl.where(after == last, last, -2)  # the node whose edges go on in the next tile, if there is one
    whole = inside & (receiver != before) & (receiver != unfinished)
    tl.store(received + node[:, None] * WIDTH + columns[None, :], sums.to(dtype), mask=whole[:, None] & present[None, :])
    ends = borders + tile * WIDTH + columns[None, :] + tl.zeros((TILE, 1), tl.int32)
    tl.store(ends, sums, mask=(rows == tile * TILE)[:, None] & present[None, :])
    tl.store(ends + tiles * WIDTH, sums, mask=(rows == stop - 1)[:, None] & present[None, :])


@triton.jit
def border_pass(
    receivers,
    local_receivers,
    offsets,
    borders,
    received,
    tiles,
    WIDTH: tl.constexpr,
    PADDED: tl.constexpr,
    TILE: tl.constexpr,
    CHUNK: tl.constexpr,
):
    """The sum at the last node of a tile if its edges begin there and go on in the next tiles."""
    tile = tl.program_id(0)
    columns = tl.arange(0, PADDED)
    present = columns < WIDTH
    stop = (tile + 1) * TILE
    local = tl.load(local_receivers + stop - 1)
    begins = tl.load(offsets + local) >= tile * TILE
    end = tl.load(offsets + local + 1)
    if begins & (end > stop):
        total = tl.load(borders + (tiles + tile) * WIDTH + columns, mask=present, other=0.0)
        final = (end - 1) // TILE
        start = tile + 1
        while start <= final:  # a range with bounds of the device is not known to Triton's interpreter
            others = start + tl.arange(0, CHUNK)
            mask = (others <= final)[:, None] & present[None, :]
            total += tl.sum(tl.load(borders + others[:, None] * WIDTH + columns[None, :], mask=mask, other=0.0), axis=0)
            start += CHUNK
        node = tl.load(receivers + stop - 1).to(tl.int64)
        tl.store(received + node * WIDTH + columns, total.to(received.dtype.element_ty), mask=present)


@triton.jit
def nodes_pass(
    nodes,
    received,
    weight_1,
    stride_1,
    bias_1,
    weight_2,
    bias_2,
    weight_3,
    bias_3,
    scale,
    shift,
    updated,
    count,
    eps,
    PRECISION: tl.constexpr,
    WIDEN: tl.constexpr,
    WIDTH: tl.constexpr,
    PADDED: tl.constexpr,
    TILE: tl.constexpr,
    SETS: tl.constexpr,
):
    """New latents of TILE nodes from their own and the sums that they received from every edge set."""
    rows = tl.program_id(0) * TILE + tl.arange(0, TILE)
    columns = tl.arange(0, PADDED)
    present = columns < WIDTH
    both = (rows < count)[:, None] & present[None, :]
    places = rows[:, None].to(tl.int64) * WIDTH + columns[None, :]
    dtype = received.dtype.element_ty
    node = tl.load(nodes + places, mask=both, other=0.0)
    hidden = layer_of(node.to(dtype), weight_1, stride_1, columns, present, PRECISION, WIDEN)
    for place in tl.static_range(SETS):
        sums = tl.load(received + place * count * WIDTH + places, mask=both, other=0.0)
        hidden += layer_of(sums, weight_1 + (place + 1) * WIDTH, stride_1, columns, present, PRECISION, WIDEN)
    hidden += vector_of(bias_1, columns, present)[None, :]
    rest = (weight_2, bias_2, weight_3, bias_3, scale, shift)
    out = _tail(hidden, *rest, columns, present, eps, dtype, PRECISION, WIDEN, WIDTH)
    tl.store(updated + places, node + out.to(node.dtype), mask=both)


@triton.jit
def tail_pass(
    hidden,
    residual,
    weight_2,
    bias_2,
    weight_3,
    bias_3,
    scale,
    shift,
    out,
    count,
    eps,
    PRECISION: tl.constexpr,
    WIDEN: tl.constexpr,
    WIDTH: tl.constexpr,
    PADDED: tl.constexpr,
    TILE: tl.constexpr,
    ADD: tl.constexpr,
):
    """A network behind its first layer for TILE rows; plus ``residual`` with ADD."""
    rows = tl.program_id(0) * TILE + tl.arange(0, TILE)
    columns = tl.arange(0, PADDED)
    present = columns < WIDTH
    both = (rows < count)[:, None] & present[None, :]
    places = rows[:, None].to(tl.int64) * WIDTH + columns[None, :]
    first = tl.load(hidden + places, mask=both, other=0.0)
    rest = (weight_2, bias_2, weight_3, bias_3, scale, shift)
    result = _tail(first.to(tl.float32), *rest, columns, present, eps, hidden.dtype.element_ty, PRECISION, WIDEN, WIDTH)
    if ADD:
        result += tl.load(residual + places, mask=both, other=0.0).to(tl.float32)
    tl.store(out + places, result.to(out.dtype.element_ty), mask=both)
