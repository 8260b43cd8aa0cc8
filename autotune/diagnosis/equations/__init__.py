"""Diagnosis of models of equations, of chains with several inputs and of black boxes.

``candidates``
    which effects can sit where, by what states, ports and inputs say of themselves, with values to try
``bench``
    what a search asks of any model: fit it with effects, try one more, tell what numbers and starts can explain
``search``
    first order screens all candidates, fits decide, one effect after the other
``evidence``
    what recordings show: what :func:`autotune.diagnosis.diagnose` asks of models of every kind
"""
