"""SBML documents for tests, written from infix formulas."""

from __future__ import annotations

import textwrap

CORE = "http://www.sbml.org/sbml/level3/version2/core"
LEVEL_2 = "http://www.sbml.org/sbml/level2/version4"


def math(formula):
    """A formula such as ``k*S1`` as MathML."""
    import libsbml

    node = libsbml.parseL3Formula(formula)
    assert node is not None, libsbml.getLastParseL3Error()
    return libsbml.writeMathMLToString(node).split("\n", 1)[1]


def parameter(name, value=None, constant=True):
    number = "" if value is None else f' value="{value}"'
    return f'<parameter id="{name}"{number} constant="{str(constant).lower()}"/>'


def compartment(name="C", size=1.0, constant=True):
    return (
        f'<compartment id="{name}" spatialDimensions="3" size="{size}" '
        f'constant="{str(constant).lower()}"/>'
    )


def species(name, amount=None, concentration=None, only_amounts=False, boundary=False, **more):
    start = "" if amount is None else f' initialAmount="{amount}"'
    start += "" if concentration is None else f' initialConcentration="{concentration}"'
    further = "".join(f' {key}="{text}"' for key, text in more.items())
    return (
        f'<species id="{name}" compartment="C"{start} constant="false" '
        f'hasOnlySubstanceUnits="{str(only_amounts).lower()}" '
        f'boundaryCondition="{str(boundary).lower()}"{further}/>'
    )


def reference(name, stoichiometry=1, key=None):
    named = "" if key is None else f'id="{key}" '
    number = "" if stoichiometry is None else f'stoichiometry="{stoichiometry}" '
    return f'<speciesReference {named}species="{name}" {number}constant="true"/>'


def reaction(name, reactants, products, law, local="", more=""):
    """Reactants and products are ids, or whole references."""

    def side(tag, names):
        references = "".join(n if n.startswith("<") else reference(n) for n in names)
        return f"<{tag}>{references}</{tag}>" if names else ""

    modifiers = ""
    locals_ = f"<listOfLocalParameters>{local}</listOfLocalParameters>" if local else ""
    return (
        f'<reaction id="{name}" reversible="false"{more}>'
        f"{side('listOfReactants', reactants)}{side('listOfProducts', products)}{modifiers}"
        f"<kineticLaw>{math(law)}{locals_}</kineticLaw></reaction>"
    )


def assignment_rule(name, formula):
    return f'<assignmentRule variable="{name}">{math(formula)}</assignmentRule>'


def rate_rule(name, formula):
    return f'<rateRule variable="{name}">{math(formula)}</rateRule>'


def algebraic_rule(formula):
    return f"<algebraicRule>{math(formula)}</algebraicRule>"


def initial_assignment(name, formula):
    return f'<initialAssignment symbol="{name}">{math(formula)}</initialAssignment>'


def function(name, formula):
    return f'<functionDefinition id="{name}">{math(formula)}</functionDefinition>'


def event(
    name, trigger, then, delay=None, priority=None, before=True, persistent=True, at_trigger=True
):
    """``then`` maps ids to formulas; ``before`` is the trigger's initial value."""
    parts = [
        f'<event id="{name}" useValuesFromTriggerTime="{str(at_trigger).lower()}">',
        f'<trigger initialValue="{str(before).lower()}" persistent="{str(persistent).lower()}">'
        f"{math(trigger)}</trigger>",
    ]
    parts += [f"<delay>{math(delay)}</delay>"] if delay else []
    parts += [f"<priority>{math(priority)}</priority>"] if priority else []
    assignments = "".join(
        f'<eventAssignment variable="{variable}">{math(formula)}</eventAssignment>'
        for variable, formula in then.items()
    )
    return "".join(
        [*parts, f"<listOfEventAssignments>{assignments}</listOfEventAssignments></event>"]
    )


LISTS = (
    ("functions", "listOfFunctionDefinitions"),
    ("units", "listOfUnitDefinitions"),
    ("compartments", "listOfCompartments"),
    ("species", "listOfSpecies"),
    ("parameters", "listOfParameters"),
    ("assignments", "listOfInitialAssignments"),
    ("rules", "listOfRules"),
    ("reactions", "listOfReactions"),
    ("events", "listOfEvents"),
)


def document(attributes="", version=2, **lists):
    """A document of Level 3 from lists of elements: ``document(parameters=[...], rules=[...])``."""
    body = "".join(
        f"<{tag}>{''.join(lists.pop(key))}</{tag}>" for key, tag in LISTS if lists.get(key)
    )
    assert not lists, f"unknown lists {list(lists)}"
    core = CORE.replace("version2", f"version{version}")
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><sbml xmlns="{core}" level="3" '
        f'version="{version}"><model id="m"{attributes}>{body}</model></sbml>'
    )


DECAY_LEVEL_2 = textwrap.dedent(
    f"""\
    <?xml version="1.0" encoding="UTF-8"?>
    <sbml xmlns="{LEVEL_2}" level="2" version="4">
      <model id="old">
        <listOfCompartments><compartment id="C" size="2"/></listOfCompartments>
        <listOfSpecies>
          <species id="A" compartment="C" initialAmount="6"/>
          <species id="B" compartment="C" initialAmount="0"/>
        </listOfSpecies>
        <listOfParameters><parameter id="k" value="0.5"/></listOfParameters>
        <listOfReactions>
          <reaction id="R" reversible="false">
            <listOfReactants><speciesReference species="A"/></listOfReactants>
            <listOfProducts>
              <speciesReference species="B">
                <stoichiometryMath>
                  <math xmlns="http://www.w3.org/1998/Math/MathML"><cn> 2 </cn></math>
                </stoichiometryMath>
              </speciesReference>
            </listOfProducts>
            <kineticLaw>
              <math xmlns="http://www.w3.org/1998/Math/MathML">
                <apply><times/><ci> C </ci><ci> k </ci><ci> A </ci></apply>
              </math>
            </kineticLaw>
          </reaction>
        </listOfReactions>
      </model>
    </sbml>
    """
)
