"""SlotFormer: slots predicted without actions."""
