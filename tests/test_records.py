"""Records from files: the first problem is named with its place, further ones are counted, types are not converted."""

from __future__ import annotations

from typing import Annotated, Any

import pytest
from pydantic import Field
from refusals import refused

from mudg.base.errors import InputError
from mudg.base.records import Number, StrictRecord, after, named_by, parse_record


def check_even(value: int) -> int:
    if value % 2:
        raise InputError("number is odd", expected="an even number", got=str(value), remedy="add one")
    return value


class Wheel(StrictRecord):
    radius_m: Number
    spokes: Annotated[int, after(check_even)] = 4


class Cart(StrictRecord):
    name: str = Field(alias="id")
    wheels: list[Wheel]
    painted: bool = False


GOOD: dict[str, Any] = {"id": "a", "wheels": [{"radius_m": 1}, {"radius_m": 0.5, "spokes": 6}]}


def test_a_good_record_is_parsed_and_frozen() -> None:
    cart = parse_record(Cart, GOOD, "cart.json: ")
    assert (cart.name, cart.wheels[0].radius_m, cart.wheels[1].spokes) == ("a", 1.0, 6)
    with pytest.raises(ValueError, match="frozen"):
        cart.name = "b"


@pytest.mark.parametrize(
    ("value", "what", "where", "detail"),
    [
        ({**GOOD, "wheel": 1}, "unknown field 'wheel'", "cart.json", "did you mean 'wheels'?"),
        ({"wheels": []}, "the field 'id' is missing", "cart.json", "wheels"),
        ({"id": 3, "wheels": []}, "not a text", "cart.json: id", "3"),
        ({**GOOD, "painted": "yes"}, "neither true nor false", "cart.json: painted", "'yes'"),
        ({**GOOD, "painted": 1}, "neither true nor false", "cart.json: painted", "1"),
        ({**GOOD, "wheels": {}}, "not a list", "cart.json: wheels", "{}"),
        ({**GOOD, "wheels": [{"radius_m": 1}, 7]}, "record is not an object", "cart.json: wheels[1]", "7"),
        ({**GOOD, "wheels": [{"radius_m": "1.5"}]}, "not a number", "cart.json: wheels[0].radius_m", "'1.5'"),
        ({**GOOD, "wheels": [{"radius_m": True}]}, "not a number", "cart.json: wheels[0].radius_m", "True"),
        ({**GOOD, "wheels": [{"radius_m": 10**400}]}, "not finite", "cart.json: wheels[0].radius_m", "finite"),
        ({**GOOD, "wheels": [{"radius_m": 1, "spokes": 3}]}, "odd", "cart.json: wheels[0].spokes", "add one"),
        ({**GOOD, "wheels": [{"radius_m": 1, "spokes": 4.0}]}, "whole number", "cart.json: wheels[0].spokes", "4.0"),
        ({**GOOD, "wheels": [{"radius_m": 1, "spoke": 4}]}, "unknown field", "cart.json: wheels[0]", "'spokes'"),
        ([], "record is not an object", "cart.json", "[]"),
    ],
)
def test_the_first_problem_is_named(value: object, what: str, where: str, detail: str) -> None:
    error = refused(".", parse_record, Cart, value, "cart.json: ")
    assert what in error.what and error.where == where and detail in str(error)


def test_further_problems_are_counted_long_values_shortened_and_owners_replaced() -> None:
    assert refused(".", parse_record, Cart, {"id": 1, "wheels": [1, 2]}, "cart.json: ").got == "1 (and 2 more problems)"
    assert len(refused(".", parse_record, Wheel, {"radius_m": "x" * 1000}, "wheel").got) == 80
    with pytest.raises(InputError) as caught, named_by("a.json: tracks[1]"):
        raise InputError("wrong", where="track 'b: c': poses[4]", got="x", remedy="mend it")
    assert (caught.value.where, caught.value.got, caught.value.remedy) == ("a.json: tracks[1].poses[4]", "x", "mend it")
