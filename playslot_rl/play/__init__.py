"""Play: an imagined future steered by hand, the simulator beside it, and the page in the browser that shows both."""
