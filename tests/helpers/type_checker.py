"""Type checker for jaxtyping's import hook, whose pytest option accepts such a call for one package only."""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
