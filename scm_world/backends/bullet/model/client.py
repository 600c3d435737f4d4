from scm_world.backends.bullet.client import Client

class ModelClient(Client):
    pass
