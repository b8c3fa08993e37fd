MOVEMENTS = {}


def movement(*a):
    raise NotImplementedError
