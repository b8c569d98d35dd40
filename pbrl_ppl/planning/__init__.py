"""Goals, actions and the searches for a plan under posterior draws."""

import lazy_loader

# experiments and rehearsals need the samplers, which a plan does not
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
