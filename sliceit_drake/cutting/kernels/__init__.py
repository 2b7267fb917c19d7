"""The Warp kernels of the food, by what they run over."""
