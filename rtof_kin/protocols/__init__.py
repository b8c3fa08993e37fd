"""Published evaluation protocols, run on a dataset that the user has, beside the published figures."""
