"""OCVP-Seq: slots predicted without actions."""
