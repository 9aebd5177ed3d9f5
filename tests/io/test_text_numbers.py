"""Numbers of a text are those that float() gives, whatever they look like."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_core.io.text_numbers import numbers_of_text

FORMS = ("%.6f", "%.9f", "%.3f", "%.0f", "%d", "%g", "%.15g", "%.17g", "%+.2f", "%e", "%08.3f", "%.12f")
NUMBERS = st.floats(-1e7, 1e7, allow_subnormal=False)


@given(
    st.lists(st.tuples(NUMBERS, st.sampled_from(FORMS)), min_size=1),
    st.sampled_from([" ", "\n", "\t ", "\r\n"]),
)
def test_every_word_is_what_float_makes_of_it(values, blank):
    words = [form % value for value, form in values]
    found = numbers_of_text(blank.join(words).encode())
    np.testing.assert_array_equal(found, [float(word) for word in words])
    np.testing.assert_array_equal(np.signbit(found), [word.startswith("-") for word in words])


@pytest.mark.parametrize("form", FORMS)
def test_long_texts_of_one_form(form):
    rng = np.random.default_rng(FORMS.index(form))
    words = [form % value for value in rng.normal(size=2000) * 10 ** rng.uniform(-5, 6, 2000)]
    np.testing.assert_array_equal(numbers_of_text(" ".join(words).encode()), [float(word) for word in words])


@pytest.mark.parametrize(
    "word", ["-", ".", "-.", "1..2", "1.2.3", "1-2", "--1", "1,5", "0x10", "1_000", "\xff", "1e"]
)
@pytest.mark.parametrize("others", [0, 100])
def test_what_is_no_number_is_refused(word, others):
    with pytest.raises(ValueError, match=r"could not convert|an underscore"):
        numbers_of_text(" ".join(["1.25"] * others + [word] + ["2"] * others).encode("latin-1"))


@pytest.mark.parametrize("text", [b"", b" \n\t"])
def test_a_text_without_words_has_none(text):
    assert len(numbers_of_text(text)) == 0
