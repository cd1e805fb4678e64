"""SOLD: slots, an action-conditioned slot transformer, actor and critic trained in imagination."""
