"""TripoSR in Flax (nnx): one photo to a triplane, and the field of density and colour that the triplane holds.

The published model (https://github.com/VAST-AI-Research/TripoSR, MIT): DINO ViT-B/16 tokens of the photo (`vision`),
learned triplane tokens, a transformer in which these attend to the photo's, an up-sampler, and a small MLP from the
three planes' features of a point to density and colour (`model`). `field` and `renderer` sample the triplane,
`weights` maps the published checkpoint to our parameters. Everything is written for one photo; the caller vmaps.

Frame of the field, here called ``mesh``: right-handed, +x towards the input camera, +y to the image's right, +z up;
the object lies in the cube of half side ``radius``. The scale is arbitrary: the network is given no camera.
"""
