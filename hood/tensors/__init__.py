"""Operations on tensors that several rooms share: dense products, conjugate gradients of fixed size, batches, precision.

Never knows a mesh, a cloth or a network.
"""
