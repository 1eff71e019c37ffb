"""Speed-against-error reports: references, untuned and fitted modules, tables, plots, one page."""

from torch_ssao.report.environment import environment as environment
from torch_ssao.report.make import make_report as make_report
from torch_ssao.report.measure import measure as measure
from torch_ssao.report.measurement import Constant as Constant
from torch_ssao.report.measurement import Measurement as Measurement
from torch_ssao.report.rows import Row as Row
from torch_ssao.report.rows import Score as Score
from torch_ssao.report.rows import Timing as Timing
from torch_ssao.report.truth import Ceiling as Ceiling
from torch_ssao.report.truth import Truth as Truth
