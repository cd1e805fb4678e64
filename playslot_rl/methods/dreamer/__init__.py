"""DreamerV3 from pixels, from TorchRL's parts."""
