"""The maths: plain tensors in, plain tensors out, in paper order and paper symbols.

Shapes: B batch, T frames, N slots, D slot width, K prototypes, Z latent-action width, A action width,
H and W image height and width, L feature locations.
"""
