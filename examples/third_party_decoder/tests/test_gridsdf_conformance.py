from lampopt_gridsdf import GridSDF

from lampopt.testing import decoder_checks


@decoder_checks(GridSDF(size=24))
def test_gridsdf_conforms(check):
    check()
