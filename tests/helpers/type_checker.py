"""Type checker for jaxtyping's import hook, whose pytest option accepts a call for only one package."""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
