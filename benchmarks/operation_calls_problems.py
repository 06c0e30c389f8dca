"""Bad calls of problems, conditions, solvers, terms, figures and studies; see `operation_calls`."""

import matplotlib.figure  # noqa: F401  (once for all forked children)

# from the first tests of bad calls
FIRST = [
    ("pm.QuasiStatic(None,pts())", "bad", ("grid",)),
    ("pm.QuasiStatic(grid(),None)", "bad", ("points",)),
    ("pm.QuasiStatic(pts(),grid())", "bad", ("grid", "points")),
    ("pm.QuasiStatic(grid(3),pts())", "bad", ("dimension",)),
    ('prob(basis="quintic")', "bad", ("basis",)),
    ("prob(basis=None)", "bad", ("basis",)),
    ('prob(basis=["mpm"])', "bad", ("basis",)),
    ('prob(assembly="x")', "bad", ("assembly",)),
    ("prob(assembly=None)", "bad", ("assembly",)),
    ('prob(basis="gimpm",assembly="projection")', "bad", ("assembly",)),
    ("prob(reset=0)", "bad", ("reset",)),
    ("prob(reset=-3)", "bad", ("reset",)),
    ("prob(reset=1.5)", "bad", ("reset",)),
    ('prob(reset="never")', "bad", ("reset",)),
    ("prob(reset=pm.WhenDistorted)", "bad", ("reset",)),
    ("q=loaded(reset=pm.Never)\nrun(q)", "bad", ("reset",)),
    ('prob(balanced_reset="no")', "bad", ("balanced_reset",)),
    ("prob(balanced_reset=None)", "bad", ("balanced_reset",)),
    ('prob(ghost="heavy")', "bad", ("ghost",)),
    ("prob(ghost=1.0)", "bad", ("ghost",)),
    ("prob(ghost=pm.GhostPenalty)", "bad", ("ghost",)),
    ('prob(basis="bspline",ghost="light")', "bad", ("ghost",)),
    ("prob(rebalance=0.5)", "bad", ("rebalance",)),
    ('prob(rebalance="x")', "bad", ("rebalance",)),
    ('prob(rebalance=float("nan"))', "bad", ("rebalance",)),
    ('prob(controls="fast")', "bad", ("controls",)),
    ('prob(controls={"force_tolerance":1e-3})', "bad", ("controls",)),
    ('prob(solver="cg")', "bad", ("solver",)),
    ("prob(solver=None)", "bad", ("solver",)),
    ('q=loaded(solver="multigrid")\nrun(q)\nshow(q)', "either", ()),
    (
        "p=pts()\n"
        'a=pm.QuasiStatic(grid(),p,basis="mpm")\n'
        'b=pm.QuasiStatic(grid(),p,basis="mpm")\n'
        "for q in (a,b):\n"
        "    q.fix(lambda x: x[:,0]<1e-6,u=0,theta=0)\n"
        "    q.load(p.farthest((1,0)),force=(0,1e3))\n"
        "run(a)\n"
        "u1=p.mean_displacement()\n"
        "run(b)\n"
        "u1,p.mean_displacement()",
        "bad",
        ("points", "another problem"),
    ),
    (
        "q=loaded(controls=pm.Controls(force_tolerance=-1,energy_tolerance=-1))\nrun(q)",
        "bad",
        ("force_tolerance",),
    ),
    (
        'q=loaded(controls=pm.Controls(force_tolerance=float("nan"),energy_tolerance=float("nan")))\nrun(q)',
        "bad",
        ("force_tolerance",),
    ),
    ('q=loaded(controls=pm.Controls(force_tolerance="1e-9"))\nrun(q)', "bad", ("force_tolerance",)),
    ("q=loaded(controls=pm.Controls(force_tolerance=None))\nrun(q)", "bad", ("force_tolerance",)),
    (
        "q=loaded(f=1e3,controls=pm.Controls(force_tolerance=2.0))\nrun(q)\nshow(q)",
        "bad",
        ("force_tolerance",),
    ),
    (
        'q=loaded(f=1e3,controls=pm.Controls(force_tolerance=float("inf")))\nrun(q)\nshow(q)',
        "bad",
        ("force_tolerance",),
    ),
    (
        'q=loaded(f=1e3,controls=pm.Controls(energy_tolerance=float("inf")))\n'
        "s=run(q)\n"
        "show(q), s[-1].history",
        "bad",
        ("energy_tolerance",),
    ),
    ("q=loaded(controls=pm.Controls(max_iterations=0))\nrun(q)", "bad", ("max_iterations",)),
    ("q=loaded(controls=pm.Controls(max_iterations=-5))\nrun(q)", "bad", ("max_iterations",)),
    ('q=loaded(controls=pm.Controls(max_iterations="x"))\nrun(q)', "bad", ("max_iterations",)),
    ("q=loaded(controls=pm.Controls(divergence=0))\nrun(q)", "bad", ("divergence",)),
    (
        "q=prob()\n"
        "q.fix(pm.plane(x=5.0),u=0,theta=0)\n"
        "q.load(q.points.farthest((1,0)),force=(0,1.0))\n"
        "run(q)\n"
        "show(q)",
        "bad",
        ("plane", "node"),
    ),
    ("q=clamped()\nq.fix(lambda x: x[:,0]>99,ux=0.1)\nrun(q)\nshow(q)", "bad", ("node", "support 2")),
    ("q=femc()\nq.fix(lambda x: x[:,0]>99,ux=0.1)\nrun(q)\nshow(q)", "bad", ("node", "support 2")),
    ("prob().fix(None,u=0)", "bad", ("where",)),
    ('prob().fix("left",u=0)', "bad", ("where",)),
    ("prob().fix(pm.plane(x=0.0))", "bad", ("component",)),
    ("prob().fix(pm.plane(x=0.0),w=0)", "bad", ("'w'",)),
    ("prob().fix(pm.plane(x=0.0),u=0,ux=0)", "bad", ("ux",)),
    ("prob(m=NH).fix(pm.plane(x=0.0),theta=0)", "bad", ("theta",)),
    ('prob().fix(pm.plane(x=0.0),u="0")', "either", ("u",)),
    ("prob().fix(pm.plane(x=0.0),u=None)", "bad", ("u",)),
    ("prob().fix(pm.plane(x=0.0),u=True)", "either", ("u",)),
    ("prob().fix(pm.plane(x=0.0),u=(1,2,3))", "bad", ("u",)),
    ("prob().fix(pm.plane(x=0.0),u=lambda: 0.0)", "bad", ("u", "argument")),
    ("prob().fix(pm.plane(x=0.0),u=lambda t: None)", "bad", ("u",)),
    ("q=prob()\nq.fix(pm.plane(x=0.0),u=lambda t,X: np.zeros((3,2)))\nrun(q)", "bad", ("u",)),
    ("q=prob()\nq.fix(lambda x: 3,u=0)\nrun(q)", "bad", ("predicate",)),
    ("q=prob()\nq.fix(lambda x: np.nonzero(x[:,0]<0)[0],u=0)\nrun(q)", "bad", ("predicate",)),
    ("q=prob()\nq.fix(lambda: 3,u=0)\nrun(q)", "bad", ("where",)),
    ("q=clamped()\nq.fix(lambda x: x[:,0]<1e-6,ux=1.0)\nrun(q)", "bad", ("contradict",)),
    (
        "q=prob(3)\n"
        "q.fix(lambda x: x[:,0]<1e-6,u=0,theta=0)\n"
        "q.fix(lambda x: x[:,0]>2.9,theta_x=10.0)\n"
        "run(q)\n"
        "show(q)",
        "either",
        ("pi", "rotation", "tried"),
    ),
    (
        "q=prob(3)\n"
        "q.fix(lambda x: x[:,0]<1e-6,u=0,theta=0)\n"
        "q.fix(lambda x: x[:,0]>2.9,theta=(2*np.pi,0,0))\n"
        "run(q)\n"
        "q.points.rotation_vector.max()",
        "bad",
        ("pi", "rotation"),
    ),
    ("q=clamped()\nq.fix(lambda x: x[:,0]>2.9,ux=-10.0)\nrun(q)", "bad", ("tried", "inside out")),
    ("q=clamped()\nq.fix(lambda x: x[:,0]>2.9,ux=1e300)\nrun(q)", "bad", ("tried",)),
    ("q=loaded()\nrun(q)\nq.fix(pm.plane(y=0.0,moving=True),uy=-0.1)", "bad", ("moving",)),
    ("q=prob()\nq.fix(pm.plane(y=0.0,moving=True),ux=0)", "bad", ("moving",)),
    ("clamped().load(None,force=(0,1))", "bad", ("selection",)),
    ("clamped().load([1],force=(0,1))", "bad", ("selection",)),
    ("q=clamped()\nq.load(q.points.where(lambda x: x[:,0]>99),force=(0,1))", "bad", ("selection",)),
    ("q=clamped()\nq.load(q.points.farthest((1,0)))", "bad", ("force",)),
    ('q=clamped()\nq.load(q.points.farthest((1,0)),force=(0,float("nan")))', "bad", ("force",)),
    ('q=clamped()\nq.load(q.points.farthest((1,0)),force="10")', "either", ("force",)),
    ("q=clamped()\nq.load(q.points.farthest((1,0)),force=(0,0,1))", "bad", ("force",)),
    ("q=clamped()\nq.load(q.points.farthest((1,0)),force=(0,1),couple=(0,0,1))", "bad", ("couple",)),
    ("q=clamped()\nq.load(q.points.farthest((1,0)),force=(0,1e300))\nrun(q)", "bad", ("tried",)),
    ("q=clamped()\nq.load(q.points.farthest((1,0)),force=(0,1e200))\nrun(q)", "bad", ("tried",)),
    (
        "q=clamped()\nq.load(q.points.farthest((1,0)),force=(0,1e-300))\nrun(q)\nshow(q)",
        "either",
        (),
    ),
    ('q=clamped()\nq.load(q.points.farthest((1,0)),force=lambda t: "a")', "bad", ("force",)),
    (
        "q=clamped()\nq.load(q.points.farthest((1,0)),force=lambda t,X: X[:,:1]*np.nan)\nrun(q)",
        "bad",
        ("force",),
    ),
    ("q=clamped()\nq.load(q.points.farthest((1,0)),force=lambda t,X,z: 0)\nrun(q)", "bad", ("force",)),
    ("q=clamped(m=NH)\nq.load(q.points.farthest((1,0)),couple=1.0)", "bad", ("couple",)),
    ("clamped().body_load()", "bad", ("force",)),
    ("q=clamped()\nq.body_load(force=(0,1),on=[1,2])\nrun(q)", "bad", ("on", "selection")),
    ('q=clamped()\nq.body_load(force=(0,1),on="all")\nrun(q)', "bad", ("on", "selection")),
    ("q=clamped()\nq.body_load(force=(0,1),on=lambda x: x[:,0]>0)\nrun(q)", "bad", ("on", "selection")),
    ("q=clamped()\nq.body_load(force=np.ones((5,2)))", "bad", ("force",)),
    ("q=prob()\nrun(q)\nshow(q)", "either", ("support",)),
    (
        "q=prob()\nq.load(q.points.farthest((1,0)),force=(0,10.0))\nrun(q)\nshow(q)",
        "bad",
        ("support", "singular", "rigid", "tried"),
    ),
    (
        'q=prob(basis="bspline")\nq.load(q.points.farthest((1,0)),force=(0,10.0))\nrun(q)\nshow(q)',
        "bad",
        ("support", "singular", "rigid", "tried"),
    ),
    (
        "q=prob(3)\nq.load(q.points.farthest((1,0,0)),force=(0,0,10.0))\nrun(q)\nshow(q)",
        "bad",
        ("support", "singular", "rigid", "tried"),
    ),
    (
        "q=prob(m=NH)\nq.load(q.points.farthest((1,0)),force=(0,10.0))\nrun(q)\nshow(q)",
        "bad",
        ("support", "singular", "rigid", "tried"),
    ),
    (
        "q=fem()\nq.load(lambda x: x[:,0]>2.99,force=(0,10.0))\nrun(q)\nshow(q)",
        "bad",
        ("support", "singular", "rigid", "tried"),
    ),
    (
        "q=prob()\n"
        "q.fix(lambda x: x[:,0]<1e-6,ux=0)\n"
        "q.load(q.points.farthest((1,0)),force=(0,10.0))\n"
        "run(q)\n"
        "show(q)",
        "bad",
        ("support", "singular", "rigid", "tried"),
    ),
    (
        "q=prob()\nq.fix(lambda x: x[:,0]<1e-6,ux=0)\nq.body_load(force=(0,10.0))\nrun(q)\nshow(q)",
        "bad",
        ("support", "singular", "rigid", "tried"),
    ),
    (
        "# two pieces, one floats\n"
        "p=pm.seed(pm.Grid.box((-1,-1),(8,3),1.0),lambda x:(x[:,1]>0)&(x[:,1]<1)&(x[:,"
        "0]>0)&((x[:,0]<2)|(x[:,0]>5)),material=MP)\n"
        'q=pm.QuasiStatic(pm.Grid.box((-1,-1),(8,3),1.0),p,basis="mpm")\n'
        "q.fix(lambda x: x[:,0]<1e-6,u=0,theta=0)\n"
        "q.load(p.farthest((1,0)),force=(10.0,0))\n"
        "run(q)\n"
        "show(q)",
        "bad",
        ("support", "singular", "rigid", "tried"),
    ),
    (
        "p=pm.seed(grid(),lambda x:(abs(x[:,0]-.25)<.1)&(abs(x[:,1]-.25)<.1),material=MP)\n"
        'q=pm.QuasiStatic(grid(),p,basis="mpm")\n'
        "q.fix(lambda x: x[:,0]<1e-6,u=0,theta=0)\n"
        "q.load(p.farthest((1,0)),force=(10.0,0))\n"
        "run(q)\n"
        "len(p),show(q)",
        "either",
        ("singular", "tried"),
    ),
    ("loaded().march()", "bad", ("steps",)),
    ("loaded().march(0)", "bad", ("steps",)),
    ("loaded().march(-1)", "bad", ("steps",)),
    ("loaded().march(1.5)", "bad", ("steps",)),
    ('loaded().march("3")', "bad", ("steps",)),
    ("loaded().march(np.int64(2))", "ok", ()),
    ("loaded().march(True)", "bad", ("steps",)),
    ('loaded().march(2,to=float("nan"))', "bad", ("to",)),
    ('loaded().march(2,to="1")', "bad", ("to",)),
    ("loaded().march(2,to=None)", "bad", ("to",)),
    ("run(loaded(),2,to=1e308)", "bad", ("tried",)),
    ("q=loaded()\nrun(q)\nrun(q)\nlen(q.steps)", "either", ()),
    ("run(loaded(),2,to=0.0)", "either", ()),
    ("loaded().march(2,smallest=0)", "bad", ("smallest",)),
    ('loaded().march(2,smallest="a",adaptive=True)', "bad", ("smallest",)),
    ("loaded().march(2,largest=1.0)", "bad", ("largest",)),
    ('loaded().march(2,largest="a",adaptive=True)', "bad", ("largest",)),
    ('list(loaded().march(2,easy="a",adaptive=True,progress=False))', "bad", ("easy",)),
    ("list(loaded().march(2,easy=-1,adaptive=True,progress=False)) and 1", "bad", ("easy",)),
    ('list(loaded().march(2,adaptive="no",progress=False)) and 1', "bad", ("adaptive",)),
    ("run(loaded(f=1e7),1,adaptive=True,smallest=0.5)", "bad", ("tried",)),
    (
        "q=loaded(f=1e3)\n"
        "a=q.march(4,progress=False)\n"
        "b=q.march(4,progress=False)\n"
        "for i in range(4):\n"
        "    next(a); next(b)\n"
        "q.progress.step,q.progress.factor",
        "bad",
        ("march",),
    ),
    ('q=loaded(f=1e3)\nq.attempt(float("nan"))', "bad", ("factor",)),
    ('q=loaded(f=1e3)\nq.attempt("1")', "bad", ("factor",)),
    ("q=loaded(f=1e3)\nq.attempt(None)", "bad", ("factor",)),
    (
        "# conditions changed inside the march loop\n"
        "q=loaded(f=1e3)\n"
        "for s in q.march(3,progress=False):\n"
        "    q.load(q.points.farthest((1,0)),force=(0,1.0))\n"
        "len(q.loads)",
        "either",
        (),
    ),
    (
        "# march inside the load function\n"
        "q=clamped()\n"
        "q.load(q.points.farthest((1,0)),force=lambda t: (list(q.march(1,progress=False)) and 0,1.0))",
        "either",
        (),
    ),
    ("loaded().march_arc_length(0.1)", "bad", ("until",)),
    ("loaded().march_arc_length(-0.1,steps=2)", "bad", ("first",)),
    ('loaded().march_arc_length("a",steps=2)', "bad", ("first",)),
    ("loaded().march_arc_length(0.1,steps=2.5)", "bad", ("steps",)),
    ("loaded().march_arc_length(0.1,until=3)", "bad", ("until",)),
    ("clamped().march_arc_length(0.1,steps=2)", "bad", ("load",)),
    ("list(loaded(f=1e3).march_arc_length(1e9,steps=1,progress=False))", "bad", ("tried",)),
    ("list(loaded(f=1e3).march_arc_length(1e-15,steps=1,progress=False)) and 1", "either", ("tried",)),
    ("loaded().reaction(None)", "bad", ("support", "step")),
    ("q=loaded()\nrun(q)\nq.reaction(None)", "bad", ("support",)),
    ('q=loaded()\nrun(q)\nq.reaction("wall")', "bad", ("support",)),
    ("a=loaded()\nb=loaded(3)\nrun(a)\nrun(b)\na.reaction(b.supports[0])", "bad", ("support",)),
    (
        "a=loaded()\nb=loaded()\nb.fix(pm.plane(y=0.0),uy=0)\nrun(a)\na.reaction(b.supports[1])",
        "bad",
        ("support",),
    ),
    ("q=loaded()\nq.fields().stress.max()", "ok", ()),
    ("q=loaded()\nq.energies()", "ok", ()),
    (
        "import copy\n"
        "q=loaded()\n"
        "run(q)\n"
        "r=copy.deepcopy(q)\n"
        "run(r,1,to=2.0)\n"
        "q.points.mean_displacement(),r.points.mean_displacement()",
        "either",
        ("copy",),
    ),
    ("import pickle\nq=loaded()\nrun(q)\npickle.dumps(q)", "either", ("pickle",)),
    ('pm.GhostPenalty("a")', "bad", ("displacement",)),
    ("pm.GhostPenalty(-1.0)", "bad", ("displacement",)),
    ("pm.GhostPenalty(1.0,rotation=None)", "bad", ("rotation",)),
    ("pm.GhostPenalty(1.0,power=2)", "bad", ("power",)),
    ("q=loaded(ghost=pm.GhostPenalty(1e300))\nrun(q)\nshow(q)", "either", ("tried",)),
    ("q=clamped()\nq.traction(pm.Surface.line((0,0),(1,0),3))", "bad", ("force",)),
    ("q=clamped()\nq.traction(None,force=(0,1))", "bad", ("surface",)),
    ('q=clamped()\nq.traction("top",force=(0,1))', "bad", ("surface",)),
    ("q=clamped(3)\nq.traction(pm.Surface.line((0,0),(1,0),3),force=(0,1,0))", "bad", ("dimension",)),
    (
        "q=clamped()\nq.traction(pm.Surface.line((-0.9,2.5),(4.5,2.5),9),force=(0,1))\nrun(q)",
        "bad",
        ("traction",),
    ),
    (
        "q=clamped()\nq.traction(pm.Surface.line((100,2.5),(104,2.5),9),force=(0,1))\nrun(q)",
        "bad",
        ("traction",),
    ),
    ('q=clamped()\nq.pressure(pm.Surface.line((0,1),(3,1),9),"a")', "bad", ("p",)),
    ("q=clamped()\nq.pressure(pm.Surface.line((0,1),(3,1),9),None)", "bad", ("p",)),
    ("q=prob()\nq.fix(pm.Surface.line((0,1),(3,1),9),stiffness=-1.0,u=0)", "bad", ("stiffness",)),
    ('q=prob()\nq.fix(pm.Surface.line((0,1),(3,1),9),stiffness="a",u=0)', "bad", ("stiffness",)),
    ("q=prob()\nq.fix(pm.Surface.line((0,1),(3,1),9),u=0,normal=0)", "bad", ("normal",)),
    ("q=prob()\nq.fix(pm.Surface.line((0,1),(3,1),9))", "bad", ("component",)),
    ('q=prob()\nq.fix(pm.Surface.line((0,1),(3,1),9),u=0,augment="yes")', "bad", ("augment",)),
    ("q=prob()\ns=q.fix(pm.Surface.line((0,1),(3,1),9),u=0)\nq.reaction(s)", "bad", ("step",)),
    ("pm.EverySteps(0)", "bad", ("n =",)),
    ('pm.EverySteps("a")', "bad", ("n =",)),
    ("pm.EverySteps(True)", "bad", ("n =",)),
    ('pm.WhenDistorted("a")', "bad", ("limit",)),
    ("pm.WhenDistorted(None)", "bad", ("limit",)),
    ("pm.WhenDistorted(-1)", "bad", ("limit",)),
    ("pm.WhenDistorted(np.array([1,2.]))", "bad", ("limit",)),
    (
        'class P:\n    def due(self,a,b,c): return "maybe"\nq=loaded(reset=P())\nrun(q,2)\n1',
        "either",
        ("reset",),
    ),
    ("class P:\n    def due(self,a): return True\nq=loaded(reset=P())\nrun(q,2)\n1", "bad", ("reset", "due")),
    ('pm.Elements(mesh2(),material=MP).facets("left")', "bad", ("left",)),
    ("pm.Elements(mesh2(),material=MP).facets(None)", "bad", ("facets",)),
    ("pm.Elements(mesh2(),material=MP).facets(lambda x: x[:,0]>99)", "bad", ("facet",)),
    ("pm.Elements(mesh2(),material=MP).facets(lambda x: 1)", "bad", ("predicate",)),
    ("pm.Elements(mesh2(),material=MP).farthest((0,0))", "bad", ("direction",)),
    ('pm.Elements(mesh2(),material=MP).farthest("x")', "bad", ("direction",)),
    ("pm.Elements(mesh2(),material=MP).farthest((1,0),tolerance=-5.0)", "bad", ("facet", "tolerance")),
    ('pm.Elements(mesh2(),material=MP).farthest((1,0),tolerance="a")', "bad", ("tolerance",)),
    ("e=pm.Elements(mesh2(),material=MP)\ne.mean(np.ones(2))", "bad", ("values",)),
    ("pm.QuasiStaticFEM(None)", "bad", ("elements",)),
    ("pm.QuasiStaticFEM(pts())", "bad", ("elements",)),
    ('fem().load("right",force=(0,1))', "bad", ("right",)),
    ("q=femc()\nq.load(pm.plane(x=3.0),force=(0,1,2))", "bad", ("force",)),
    ("q=femc()\nq.load(q.points.farthest((1,0)),force=(0,1))", "bad", ("facets", "selection")),
    ("q=femc()\nq.traction(pm.plane(x=3.0))", "bad", ("force",)),
    ("q=femc()\nq.pressure(pm.plane(x=3.0),None)", "bad", ("pressure",)),
    ("q=femc()\nq.pressure(pm.plane(x=3.0),(1,2))", "bad", ("pressure",)),
    ('q=femc()\nq.traction(pm.plane(x=3.0),force=(0,1),follows="no")', "bad", ("follows",)),
    (
        "e=pm.Elements(mesh2(),material=MP)\n"
        "a=pm.QuasiStaticFEM(e)\n"
        "b=pm.QuasiStaticFEM(e)\n"
        "for q in (a,b):\n"
        "    q.fix(pm.plane(x=0.0),u=0,theta=0)\n"
        "    q.load(pm.plane(x=3.0),force=(0,1e3))\n"
        "run(a)\n"
        "u=e.mean_displacement()\n"
        "run(b)\n"
        "u,e.mean_displacement()",
        "bad",
        ("elements", "another problem"),
    ),
    ("from polarmpm.plot import plot_points\nplot_points(None)", "bad", ("points",)),
    ("from polarmpm.plot import plot_points\nplot_points(pts(),np.ones(3))", "bad", ("values",)),
    (
        "from polarmpm.plot import plot_points\np=pts()\nplot_points(p,np.full(len(p),np.nan))\n1",
        "either",
        ("values",),
    ),
    (
        'from polarmpm.plot import plot_points\np=pts()\nplot_points(p,np.ones(len(p)),cmap="nope")',
        "bad",
        ("cmap",),
    ),
    (
        "from polarmpm.plot import plot_points\np=pts()\nplot_points(p,np.ones(len(p)),limits=(1,))",
        "bad",
        ("limits",),
    ),
    (
        "q=clamped()\n"
        'try: run(q,1,to=float("nan"))\n'
        "except Exception: pass\n"
        "q.load(q.points.farthest((1,0)),force=(0,10.0))\n"
        "run(q)\n"
        "f=q.reaction(q.supports[0])[0]\n"
        "assert abs(f[1]+10)<1e-6\n"
        "f",
        "ok",
        (),
    ),
    (
        "# after NotConverged, go on with a smaller load\n"
        "q=loaded(f=1e3)\n"
        "run(q)\n"
        "u=q.points.x.copy()\n"
        "try: run(q,1,to=1e6)\n"
        "except pm.NotConverged: pass\n"
        "assert abs(q.points.x-u).max()==0\n"
        "run(q,1,to=1.0)\n"
        "abs(q.points.x-u).max()",
        "ok",
        (),
    ),
    (
        "# user exception in load at step 3, then go on\n"
        "n=[0]\n"
        "def f(t):\n"
        "    n[0]+=1\n"
        '    if n[0]==6: raise RuntimeError("user")\n'
        "    return (0,1e3*t)\n"
        "q=clamped()\n"
        "q.load(q.points.farthest((1,0)),force=f)\n"
        "try: run(q,5)\n"
        "except RuntimeError as e: print(e)\n"
        "k=q.progress.step\n"
        "run(q,5-k)\n"
        "r=loaded(f=1e3)\n"
        "run(r,5)\n"
        "d=abs(q.points.x-r.points.x).max()\n"
        "assert d<1e-12,(d,k)\n"
        "d",
        "ok",
        (),
    ),
    ('q=loaded()\nq.progress.factor=float("nan")\nrun(q)', "either", ()),
]

# what no argument that is a number takes
NOT_NUMBERS = (
    '"1"', "None", "1j", "[]", "object()", 'float("nan")', 'float("inf")', "np.array([1.0, 2.0])", "True",
    "lambda: 1", "10**400",
)  # fmt: skip
NOT_COUNTS = ('"2"', "1.5", "2.0", "0", "-3", "True", "[2]", "np.float64(2.0)")
NOT_FLAGS = ('"no"', "0", "1", "1.0", "[]", "np.array([True])", "object()")
OTHERS = ("5", '"text"', "[1, 2]", "{}", "object()", "np.zeros(3)", "lambda x: x", "type", "1j")


def variants(template, values, *words, expected="bad"):
    """A case of each value, which stands for VALUE in the template."""
    return [(template.replace("VALUE", value), expected, words) for value in values]


def but(values, *left_out):
    """The values that aren't left out."""
    return tuple(value for value in values if value not in left_out)


ON_TIP = "q.points.farthest((1,0))"
LINE = "pm.Surface.line((0,1),(3,1),9)"

CONTROLS = [
    case
    for name in ("force_tolerance", "energy_tolerance", "divergence")
    for case in variants(f"pm.Controls({name}=VALUE)", NOT_NUMBERS, name)
]
CONTROLS += variants("pm.Controls(max_iterations=VALUE)", NOT_COUNTS, "max_iterations")
CONTROLS += [
    ("pm.Controls(force_tolerance=0.0)", "bad", ("force_tolerance",)),
    ("pm.Controls(energy_tolerance=-1e-16)", "bad", ("energy_tolerance",)),
    ("pm.Controls(energy_tolerance=0.0)", "ok", ()),
    ("pm.Controls(divergence=1)", "bad", ("divergence",)),
    ("pm.Controls(np.float32(1e-6), np.float64(1e-12), np.int64(9), np.int32(1000))", "ok", ()),
    ("run(loaded(controls=pm.Controls(np.float32(1e-6), max_iterations=np.int8(9))))", "ok", ()),
]

CONSTRUCTORS = [
    *variants("pm.QuasiStatic(VALUE,pts())", (*OTHERS, "None", "pm.Grid"), "grid ="),
    *variants("pm.QuasiStatic(grid(),VALUE)", (*OTHERS, "None", "pm.Points"), "points ="),
    *variants("pm.QuasiStaticFEM(VALUE)", (*OTHERS, "None", "mesh2()", "pm.Elements"), "elements ="),
    *variants("prob(basis=VALUE)", (*but(OTHERS, "type"), "pm.Basis", '""', "('mpm',)"), "basis"),
    *variants("prob(assembly=VALUE)", (*OTHERS, "None", '""'), "assembly"),
    *variants("prob(reset=VALUE)", (*but(OTHERS, "5"), *but(NOT_COUNTS, '"2"'), "pm.Never"), "reset"),
    *variants("prob(balanced_reset=VALUE)", (*NOT_FLAGS, "None"), "balanced_reset"),
    *variants("prob(boxes=VALUE)", NOT_FLAGS, "boxes"),
    *variants("prob(ghost=VALUE)", (*OTHERS, "True", "pm.GhostPenalty", "0.3"), "ghost"),
    *variants("prob(rebalance=VALUE)", (*but(NOT_NUMBERS, "None"), "1.0", "-2", "0"), "rebalance"),
    *variants("prob(controls=VALUE)", (*OTHERS, "pm.Controls", "1e-9", "False"), "controls"),
    *variants("prob(solver=VALUE)", (*OTHERS, "None", '""', "['direct']"), "solver"),
    *variants(
        "pm.QuasiStaticFEM(pm.Elements(mesh2(),material=MP),controls=VALUE)",
        OTHERS,
        "controls",
    ),
    *variants(
        "pm.QuasiStaticFEM(pm.Elements(mesh2(),material=MP),solver=VALUE)", (*OTHERS, "None"), "solver"
    ),
    ("prob(basis='bspline',boxes=np.bool_(True),balanced_reset=np.bool_(False))", "ok", ()),
    ("run(loaded(reset=np.int64(1)),2)", "ok", ()),
    ("run(loaded(rebalance=np.float32(1.5)))", "ok", ()),
    ("p=pts()\npm.QuasiStatic(pm.Grid.box((-1,-1),(5,3),1.0,comm=MPI.COMM_NULL),p)", "bad", ("comm",)),
    ("g=pm.Grid.box((5,5),(9,9),1.0)\npm.QuasiStatic(g,pts())", "bad", ("outside the grid",)),
]

FIX = [
    *variants("prob().fix(VALUE,u=0)", (*but(OTHERS, "lambda x: x", "type"), "None", "1.5", "True"), "where"),
    *variants(
        "fem().fix(VALUE,u=0)",
        (*but(OTHERS, "lambda x: x", "type"), "None", "1.5"),
        "where",
        "physical group",
    ),
    *variants("prob().fix(pm.plane(x=0.0),ux=VALUE)", but(NOT_NUMBERS, "lambda: 1"), "ux"),
    *variants("fem().fix(pm.plane(x=0.0),theta=VALUE)", but(NOT_NUMBERS, "lambda: 1"), "theta"),
    *variants(
        "prob().fix(pm.plane(x=0.0),u=VALUE)",
        (
            "lambda: 0.0",
            "lambda t,X,z: 0.0",
            "lambda t: 'a'",
            "lambda t: None",
            "lambda t: (1,2,3)",
            "lambda t: 1j",
            "lambda t: np.array([1j,0])",
            "lambda t: float('nan')",
            "lambda t: (0,np.inf)",
            "lambda t: [[0],[0,1]]",
            "lambda t: {}",
            "lambda t: True",
            "(1,2,3)",
            "[[0,0]]",
            "('a','b')",
            "lambda *, t: 0.0",
        ),
        "u =",
        "u returned",
        "u is",
    ),
    *variants(
        "q=clamped()\nq.fix(lambda x: x[:,0]>2.9,ux=VALUE)\nrun(q)",
        (
            "lambda t,X: None",
            "lambda t,X: np.zeros(len(X)+1)",
            "lambda t,X: X[:,0]*1j",
            "lambda t,X: X*np.nan",
            "lambda t,X: 'a'",
            "lambda t,X: X",
        ),
        "ux returned",
        "ux is",
    ),
    *variants(
        "q=clamped()\nq.fix(lambda x: VALUE,ux=0)\nrun(q)",
        ("None", "True", "x[:,0]", "x>0", "[True]", "np.zeros(len(x))", "np.zeros(len(x)+1,bool)", "'all'"),
        "predicate",
    ),
    *variants("prob().fix(pm.plane(x=0.0),u=0,counts=VALUE)", (*OTHERS, "True", "'now'"), "counts"),
    *variants("prob().fix(pm.plane(x=0.0),u=0,augment=VALUE)", but(NOT_FLAGS, "0"), "augment"),
    ("prob().fix(pm.plane(x=0.0),u=0,stiffness=1.0)", "bad", ("stiffness",)),
    ("prob().fix(pm.plane(x=0.0),u=1.0)", "bad", ("u=(1.0, 0)",)),
    ("prob().fix(pm.plane(x=0.0),u=lambda t: t)", "bad", ("u=(",)),
    ("q=clamped()\nq.fix(lambda x: x[:,0]>99,ux=0.1)\nrun(q)", "bad", ("support 2",)),
    ("q=femc()\nq.fix(lambda x: x[:,0]>99,ux=0.1)", "bad", ("support 2",)),
    ("q=clamped()\nq.fix(lambda x: x[:,1]<1e-6,ux=1.2e-18)\nrun(q)", "ok", ()),
    ("q=femc()\nq.fix(lambda x: x[:,1]<1e-6,ux=1.2e-18)\nrun(q)", "ok", ()),
    ("q=clamped()\nq.fix(lambda x: x[:,1]<1e-6,uy=lambda t: 0.1+0.2-0.3)\nrun(q)", "ok", ()),
    ("q=clamped()\nq.fix(lambda x: x[:,1]<1e-6,ux=1e-9)\nrun(q)", "bad", ("contradicts",)),
    ("q=clamped()\nq.fix(lambda x: x[:,0]>2.9,ux=np.float32(0.01),uy=np.int64(0))\nrun(q)", "ok", ()),
    ("q=clamped()\nq.fix(lambda x: list(x[:,0]>2.9),ux=0.01)\nrun(q)", "ok", ()),
    (
        "q=prob(3)\nq.fix(lambda x: x[:,0]<1e-6,u=0,theta=0)\n"
        "q.fix(lambda x: x[:,0]>2.9,theta=(0,0,7))\nrun(q)",
        "bad",
        ("theta changes by pi",),
    ),
]

LOADS = [
    *variants("clamped().load(VALUE,force=(0,1))", (*OTHERS, "None", "pm.Selection"), "selection"),
    *variants("femc().load(VALUE,force=(0,1))", (*but(OTHERS, "lambda x: x"), "None"), "facets", "group"),
    *variants("clamped().body_load(force=(0,1),on=VALUE)", OTHERS, "selection"),
    *variants("femc().body_load(force=(0,1),on=VALUE)", OTHERS, "selection"),
    *variants("clamped().traction(VALUE,force=(0,1))", (*OTHERS, "None", "pm.plane(y=1.0)"), "surface"),
    *variants("clamped().pressure(VALUE,1.0)", (*OTHERS, "None"), "surface"),
    *variants(f"q=clamped()\nq.load({ON_TIP},couple=VALUE)", but(NOT_NUMBERS, "None"), "couple"),
    *variants(
        f"q=clamped()\nq.load({ON_TIP},force=VALUE)",
        but(NOT_NUMBERS, "None", "np.array([1.0, 2.0])"),
        "force",
    ),
    *variants(f"q=clamped()\nq.load({ON_TIP},force=(0,1),counts=VALUE)", OTHERS, "counts"),
    *variants(
        f"q=clamped()\nq.load({ON_TIP},force=VALUE)\nrun(q)",
        (
            "lambda t,X: None",
            "lambda t,X: X[:,:1]",
            "lambda t,X: np.zeros((len(X)+1,2))",
            "lambda t,X: X*1j",
            "lambda t,X: X*np.nan",
            "lambda t,X: 'a'",
            "lambda t,X: X>0",
            "lambda t: ('a','b')",
            "lambda: (0,1)",
        ),
        "force",
    ),
    *variants(
        f"clamped().pressure({LINE},VALUE)",
        (*NOT_NUMBERS, "(1,2)", "lambda: 1.0", "lambda t: (1,2)"),
        "p =",
        "p is",
        "p returned",
    ),
    *variants(f"clamped().traction({LINE},force=(0,1),follows=VALUE)", NOT_FLAGS, "follows"),
    *variants("femc().traction(pm.plane(x=3.0),force=(0,1),follows=VALUE)", NOT_FLAGS, "follows"),
    *variants("femc().pressure(pm.plane(x=3.0),VALUE)", NOT_NUMBERS, "pressure"),
    *variants(f"prob().fix({LINE},u=0,stiffness=VALUE)", (*but(NOT_NUMBERS, "None"), "0", "-1"), "stiffness"),
    *variants(
        f"prob().fix({LINE},theta=0,rotation_stiffness=VALUE)",
        (*but(NOT_NUMBERS, "None"), "0"),
        "rotation_stiffness",
    ),
    *variants(f"prob().fix({LINE},normal=VALUE)", (*but(NOT_NUMBERS, "None"), "(1,2)"), "normal"),
    *variants(f"prob().fix({LINE},u=0,augment=VALUE)", NOT_FLAGS, "augment"),
    *variants(f"prob().fix({LINE},u=0,method=VALUE)", ("'lagrange'", "1", "True", "np.zeros(2)"), "method"),
    ("clamped().load(pm.Surface.line((0,1),(3,1),9))", "bad", ("force",)),
    ("femc().body_load(force=(0,1),on=pts().farthest((1,0)))", "bad", ("another body",)),
    ("clamped().load(femc().elements.points.nearest((0,0)),force=(0,1))", "bad", ("another body",)),
    ("q=clamped()\nq.load(clamped(3).points.farthest((1,0,0)),force=(0,1))", "bad", ("another body",)),
    ("femc().load(fem().elements.facets(pm.plane(x=3.0)),force=(0,1))", "bad", ("another body",)),
    (
        "q=femc()\nq.traction(fem().elements.surface(pm.plane(x=3.0)),force=(0,1))\nrun(q)",
        "bad",
        ("this mesh",),
    ),
    (
        f"q=clamped()\nq.load({ON_TIP},force=np.array([0,5],dtype=np.int32),couple=np.float32(1))\nrun(q)",
        "ok",
        (),
    ),
    (f"q=clamped()\nq.load({ON_TIP},force=[np.float32(0),np.int64(5)])\nrun(q)", "ok", ()),
    (f"q=clamped()\nq.load({ON_TIP},force=lambda t: [0,np.float32(t)])\nrun(q)", "ok", ()),
    (f"q=clamped()\nq.traction({LINE},force=(0,1),follows=np.bool_(True))\nrun(q)", "ok", ()),
    (
        f"q=clamped()\nq.load({ON_TIP},force=lambda t: q.load({ON_TIP},force=(0,t)) and (0,t))",
        "either",
        ("load step",),
    ),
]

RELEASE = [
    *variants("loaded().release(VALUE)", (*OTHERS, "None"), "no condition of this problem"),
    *variants("q=loaded()\nrun(q)\nq.release(q.supports[0],over=VALUE)", but(NOT_NUMBERS, "None"), "over"),
    *variants("q=loaded()\nrun(q)\nq.release(q.supports[0],until=VALUE)", but(NOT_NUMBERS, "None"), "until"),
    ("q=loaded()\nq.release(loaded().supports[0])", "bad", ("no condition",)),
    ("q=loaded()\nrun(q)\nq.release(q.supports[0],over=0)", "bad", ("nothing can fade",)),
    ("q=loaded()\nrun(q)\nq.release(q.supports[0],over=1,until=2)", "bad", ("one of them",)),
    ("q=loaded()\nq.release(q.supports[0],over=1.0)", "bad", ("first load step",)),
    ("q=loaded()\ns=q.supports[0]\nq.release(s)\nq.release(s)", "bad", ("already",)),
    ("q=loaded()\nrun(q)\nq.release(q.loads[0],over=np.float32(0.5))\nrun(q,2,to=2.0)", "ok", ()),
]

MARCH = [
    *variants("loaded().march(VALUE)", NOT_COUNTS, "steps"),
    *variants("loaded().march(2,to=VALUE)", NOT_NUMBERS, "to ="),
    *variants("loaded().march(2,adaptive=VALUE)", (*NOT_FLAGS, "None"), "adaptive"),
    *variants("loaded().march(2,progress=VALUE)", NOT_FLAGS, "progress"),
    *variants("loaded().march(2,adaptive=True,smallest=VALUE)", (*NOT_NUMBERS, "0", "-1", "2"), "smallest"),
    *variants(
        "loaded().march(2,adaptive=True,largest=VALUE)", (*but(NOT_NUMBERS, "None"), "0", "-1"), "largest"
    ),
    *variants("loaded().march(2,adaptive=True,easy=VALUE)", (*but(NOT_COUNTS, "0"), "None"), "easy"),
    *variants("loaded().attempt(VALUE)", NOT_NUMBERS, "factor"),
    *variants("loaded().system_at(VALUE)", NOT_NUMBERS, "factor"),
    *variants("loaded().attempt_along(VALUE)", (*NOT_NUMBERS, "0", "-1"), "length"),
    *variants("loaded().attempt_along(0.1,to=VALUE)", but(NOT_NUMBERS, "None"), "to ="),
    *variants("loaded().attempt_along(0.1,kink=VALUE)", NOT_FLAGS, "kink"),
    *variants("loaded().march_arc_length(VALUE,steps=1)", (*NOT_NUMBERS, "0", "-1"), "first"),
    *variants("loaded().march_arc_length(0.1,steps=VALUE)", NOT_COUNTS, "steps"),
    *variants("loaded().march_arc_length(0.1,to=VALUE)", but(NOT_NUMBERS, "None"), "to ="),
    *variants(
        "loaded().march_arc_length(0.1,steps=1,largest=VALUE)", (*but(NOT_NUMBERS, "None"), "0.01"), "largest"
    ),
    *variants("loaded().march_arc_length(0.1,steps=1,smallest=VALUE)", (*NOT_NUMBERS, "0", "2"), "smallest"),
    *variants(
        "loaded().march_arc_length(0.1,until=VALUE)",
        (*but(OTHERS, "lambda x: x", "type"), "lambda: 1"),
        "until",
    ),
    *variants("loaded().march_arc_length(0.1,steps=1,progress=VALUE)", NOT_FLAGS, "progress"),
    ("run(loaded(),np.int32(2),to=np.float32(0.5),adaptive=np.bool_(True))", "ok", ()),
    ("loaded().attempt(np.float32(0.5)).converged or 1/0", "ok", ()),
    ("list(loaded(f=1e3).march_arc_length(np.float32(0.01),steps=np.int64(2),progress=False))", "ok", ()),
    ("q=loaded()\nq.march()", "bad", ("steps",)),
    ("q=loaded(f=1e3)\na=q.march(4,progress=False)\nnext(a)\nrun(q,1,to=0.4)\nnext(a)", "bad", ("march",)),
    ("q=loaded(f=1e3)\na=q.march(4,progress=False)\nnext(a)\nq.attempt(0.3)\nnext(a)", "bad", ("march",)),
    (
        "q=loaded(f=1e3)\na=q.march_arc_length(0.01,steps=4,progress=False)\nnext(a)\nrun(q,1)\nnext(a)",
        "bad",
        ("march",),
    ),
    ("q=loaded()\na=q.march(4,progress=False)\nrun(q)\nq.progress.step == 1 and list(a)", "ok", ()),
    (
        "q=loaded(f=1e3)\nfor s in q.march(4,progress=False): break\nrun(q,2)\n"
        "assert q.progress.factor == 1.0",
        "ok",
        (),
    ),
    *variants(
        "q=loaded()\nrun(q)\nq.progress.factor=VALUE\nrun(q,1,to=2.0)",
        ("0.5", "None", "'1'", "-1"),
        "progress",
    ),
    ("q=loaded()\nrun(q)\nq.progress.step=7\nrun(q,1,to=2.0)", "bad", ("progress",)),
    (
        "q=clamped()\nq.load(q.points.farthest((1,0)),force=lambda t: q.attempt(t) and (0,t))\nrun(q)",
        "bad",
        ("load step",),
    ),
]

ONE_BODY = [
    (
        f"p=pts()\na,b=(pm.QuasiStatic(grid(),p,basis='mpm') for _ in 'ab')\nfor q in (a,b):\n"
        f"    q.fix(lambda x: x[:,0]<1e-6,u=0,theta=0)\n    q.load({ON_TIP},force=(0,1e3))\nrun(a)\n" + last,
        expected,
        words,
    )
    for last, expected, words in (
        ("run(b)", "bad", ("another problem",)),
        ("b.attempt(1.0)", "bad", ("another problem",)),
        ("b.system_at(1.0)", "bad", ("another problem",)),
        ("b.march_arc_length(0.1,steps=1)", "bad", ("another problem",)),
        ("list(b.march(1,adaptive=True,progress=False))", "bad", ("another problem",)),
        ("pm.save_restart(b,OUT+'/b.h5')", "bad", ("another problem",)),
        ("run(a,1,to=2.0)", "ok", ()),
        (
            "c=pm.QuasiStatic(grid(),p,basis='mpm')\nc.fix(lambda x: x[:,0]<1e-6,u=0,theta=0)\n"
            "run(c)\nrun(c,1,to=2)",
            "ok",
            (),
        ),
        ("c=pm.QuasiStatic(grid(),p,basis='mpm')\nrun(a,1,to=2.0)\nrun(a,1,to=3.0)", "ok", ()),
        (
            "c=pm.QuasiStatic(grid(),p,basis='mpm')\nc.fix(lambda x: x[:,0]<1e-6,u=0,theta=0)\n"
            "run(c)\nrun(a,1,to=2.0)",
            "bad",
            ("another problem",),
        ),
    )
]
ONE_BODY += [
    (
        "q=femc()\nr=pm.QuasiStaticFEM(q.elements)\nr.fix(pm.plane(x=0.0),u=0,theta=0)\nrun(q)\nrun(r)",
        "bad",
        ("another problem",),
    ),
    (
        "q=femc()\nrun(q)\nr=pm.QuasiStaticFEM(q.elements)\nr.fix(pm.plane(x=0.0),u=0,theta=0)\nrun(r)\nrun(r,1,to=2.0)",
        "ok",
        (),
    ),
    (
        "q=femc()\nrun(q)\nr=pm.QuasiStaticFEM(q.elements)\nr.fix(pm.plane(x=0.0),u=0,theta=0)\nrun(r)\nrun(q,1,to=2.0)",
        "bad",
        ("another problem",),
    ),
]

RESULTS = [
    *variants(
        "q=loaded()\nrun(q)\nq.reaction(VALUE)", (*OTHERS, "None", "q.loads[0]", "q.points"), "support"
    ),
    *variants(
        "q=loaded()\nrun(q)\nq.reaction(q.supports[0],about=VALUE)",
        (*but(OTHERS, "[1, 2]"), "(0,0,0)", "(0,np.nan)"),
        "about",
    ),
    *variants(
        "q=loaded()\nrun(q)\nq.balance(about=VALUE)",
        (*but(OTHERS, "[1, 2]"), "(0,0,0)", "(0,np.inf)"),
        "about",
    ),
    *variants("loaded().fields(VALUE)", (*OTHERS, "None", "''"), "fields"),
    ("q=loaded()\nq.balance()", "bad", ("no load step",)),
    ("q=loaded()\nrun(q)\nq.reaction(loaded().supports[0])", "bad", ("isn't a support of this problem",)),
    ("q=loaded()\nrun(q)\ns=q.supports[0]\nq.release(s)\nq.reaction(s)", "bad", ("released",)),
    ("q=loaded()\nrun(q)\nq.reaction(q.supports[0],about=np.array([0,1],dtype=np.int8)).moment", "ok", ()),
    ("q=loaded()\nq.fields('energy','stress'),q.energies(),q.energy(),q.trust(),q.unknowns", "ok", ()),
    ("q=loaded()\nq.rows['a']=np.zeros(3)\nrun(q)", "bad", ("rows['a']",)),
    ("q=loaded()\nq.rows['a']='text'\nrun(q)", "bad", ("rows['a']",)),
    ("q=loaded()\nq.rows['a']=np.zeros((len(q.points),4))\nrun(q,2)", "ok", ()),
    *variants("q=loaded()\nq.observers=VALUE\nrun(q)", ("None", "5", "pm.Observer()"), "observers"),
    *variants("q=loaded()\nq.rows=VALUE\nrun(q)", ("None", "5", "[1]"), "rows"),
    *variants("q=loaded()\nq.controls=VALUE\nrun(q)", ("None", "5", "pm.Controls"), "controls"),
    *variants("loaded().rotation_limit=VALUE", (*NOT_NUMBERS, "0", "-1"), "rotation_limit"),
    *variants("q=loaded()\nq.observers.append(VALUE)\nrun(q)", (*OTHERS, "None", "pm.Observer"), "observers"),
    (
        "class W(pm.Observer):\n"
        "    def after_commit(self,problem,rebased): problem.release(problem.supports[0])\n"
        "q=loaded()\nq.observers.append(W())\nrun(q)",
        "bad",
        ("load step",),
    ),
    (
        "class W(pm.Observer):\n    def after_convergence(self,problem,factor): problem.attempt(factor)\n"
        "q=loaded()\nq.observers.append(W())\nrun(q)",
        "bad",
        ("load step",),
    ),
    ("q=loaded()\nq.supports.append(1)", "bad", ("append",)),
]

TERMS = [
    *variants("loaded().add(VALUE)", (*OTHERS, "None", "pm.Term", "pm.GhostPenalty(1.0)"), "Term"),
    *variants("pm.GhostPenalty(VALUE)", (*NOT_NUMBERS, "-1", "-1e-300"), "displacement"),
    *variants("pm.GhostPenalty(1.0,VALUE)", (*NOT_NUMBERS, "-1"), "rotation"),
    *variants("pm.GhostPenalty(1.0,power=VALUE)", (*NOT_COUNTS, "2", "None"), "power"),
    ("run(loaded(ghost=pm.GhostPenalty(np.float32(1.0),np.int64(0),np.int8(3))))", "ok", ()),
    *variants(
        "pm.Boxes(VALUE,np.zeros(1,int))", ("()", "(2,)", "(0,2)", "(2.0,2)", "None", "2", "'ab'"), "count"
    ),
    *variants("pm.Boxes((2,2),VALUE)", ("None", "np.zeros((2,2),int)", "np.zeros(2)", "'a'", "1"), "lowest"),
]
SPRINGS = (
    "class W(pm.SurfaceTerm):\n    def energy(self,at,p): return VALUE\n"
    f"q=loaded()\nq.add(W('w',{LINE},{{'k':1.0}}))"
)
TERMS += variants(
    SPRINGS,
    ("None", "'a'", "at.u", "p.b*ufl.dot(at.u,at.u)", "1/0", "np.sin(at.u[0])", "at.nothing"),
    "energy",
    "scalar",
)
TERMS += variants(
    "class W(pm.SurfaceTerm):\n    def energy(self,at,p): return p.k*ufl.dot(at.u,at.u)\n"
    f"W('w',{LINE},VALUE)",
    (
        "5",
        "[1]",
        "{'k': 'a'}",
        "{'k': None}",
        "{'k': [1,2]}",
        "{'k': float('nan')}",
        "{1: 2.0}",
        "{'a b': 1.0}",
    ),
    "w: ",
)
TERMS += variants(
    f"class W(pm.SurfaceTerm):\n    def energy(self,at,p): return ufl.dot(at.u,at.u)\nW(VALUE,{LINE})",
    ("5", "None", "''"),
    "name",
)
TERMS += variants(
    "class T(pm.Term):\n    name='mine'\n    def pieces(self,setting): return VALUE\nq=loaded()\n"
    "q.add(T())\nrun(q)",
    ("None", "5", "[None]", "'a'", "[pm.Boxes((2,2),np.zeros(1,int))]", "{}", "iter([1])"),
    "mine: pieces",
)[:5]
PIECE = (
    "class P(pm.Piece):\n    name='mine'\n    def forces(self,x): return FORCES\n"
    "    def matrices(self,x): return MATRICES\n"
    "class T(pm.Term):\n    name='mine'\n    def pieces(self,setting):\n        p=P()\n"
    "        p.boxes,p.pairs=BOXES,PAIRS\n        return [p]\nq=loaded()\nq.add(T())\nrun(q)"
)
GOOD_PIECE = {
    "FORCES": "np.zeros_like(x)",
    "MATRICES": "np.zeros((1,x.shape[1],x.shape[1],1))",
    "BOXES": "pm.Boxes((2,2),setting.reached[:1])",
    "PAIRS": "np.zeros((1,2),int)",
}
for what, values in {
    "FORCES": ("None", "0.0", "x[:,:1]", "x.ravel()", "'a'"),
    "MATRICES": ("None", "np.zeros((1,2,2,1))", "0.0", "np.zeros((1,4,4,2))"),
    "BOXES": (
        "None",
        "5",
        "pm.Boxes((2,2,2),setting.reached[:1])",
        "pm.Boxes((2,2),np.array([-50]))",
        "pm.Boxes((2,2),np.array([10**9]))",
    ),
    "PAIRS": ("None", "np.zeros((1,3),int)", "np.array([[0,9]])", "np.array([[-1,0]])", "np.zeros((1,2))"),
}.items():
    for value in values:
        code = PIECE
        for key, good in GOOD_PIECE.items():
            code = code.replace(key, value if key == what else good)
        TERMS.append((code, "bad", ("mine",)))

SOLVERS = [
    *variants(
        "pm.register_solver(VALUE,lambda t: None)",
        (*but(OTHERS, '"text"'), "None", "'auto'", "'direct'", "''"),
        "solver",
    ),
    *variants(
        "pm.register_solver('mine',VALUE)",
        (*but(OTHERS, "lambda x: x", "type"), "None", "lambda: 1", "lambda a,b: 1"),
        "make",
    ),
    *variants("pm.register_solver('mine',lambda t: None,whole_rows=VALUE)", NOT_FLAGS, "whole_rows"),
    *variants("pm.EverySteps(VALUE)", (*NOT_COUNTS, "None"), "n ="),
    *variants("pm.WhenDistorted(VALUE)", (*NOT_NUMBERS, "0", "-0.1"), "limit"),
    ("pm.EverySteps(np.int64(2)),pm.WhenDistorted(np.float32(0.1))", "ok", ()),
    *variants(
        "class P:\n    VALUE\nprob(reset=P())",
        (
            "due=None",
            "due=5",
            "def due(self): return True",
            "def due(self,a): return True",
            "def due(self,a,b,c,d): return True",
        ),
        "reset",
        "due",
    ),
    ("class P:\n    def due(self,*a): return np.bool_(True)\nrun(loaded(reset=P()),2)", "ok", ()),
]

FIELDS = "m=pm.Elements(mesh2(),material=MP)\n"
SELECTIONS = [
    *variants(
        FIELDS + "m.facets(VALUE)",
        (*but(OTHERS, "lambda x: x"), "None", "lambda: 1", "1.5", "True"),
        "facets",
        "physical group",
    ),
    *variants(
        FIELDS + "m.facets(lambda x: VALUE)",
        ("None", "1", "x[:,0]", "x>0", "'a'", "[True]", "1j"),
        "predicate",
    ),
    *variants(FIELDS + "m.surface(VALUE)", ("None", "5", "'left'", "lambda x: x[:,0]>99"), "facet", "group"),
    *variants(
        FIELDS + "m.farthest(VALUE)",
        (*but(OTHERS, "[1, 2]"), "None", "(0,0)", "(1,0,0)", "(np.nan,1)"),
        "direction",
    ),
    *variants(FIELDS + "m.farthest((1,0),VALUE)", (*but(NOT_NUMBERS, "None"), "-1"), "tolerance"),
    *variants(FIELDS + "m.mean(VALUE)", (*but(OTHERS, "np.zeros(3)"), "np.zeros(3)", "None"), "values"),
    *variants(FIELDS + "m.cell_mean(VALUE)", (*OTHERS, "None"), "values"),
    *variants(FIELDS + "m.mean_displacement(VALUE)", (*but(OTHERS, "lambda x: x"), "1.5"), "facets", "group"),
    (FIELDS + "m.facets(pm.plane(z=0.0))", "bad", ("plane z",)),
    (FIELDS + "m.facets(pm.plane(x=1.1))", "bad", ("no facet",)),
    (FIELDS + "m.facets(lambda x: list(x[:,0]<1e-9)).area", "ok", ()),
    (FIELDS + "m.farthest(np.array([1,0]),np.float32(0.1)).area", "ok", ()),
]

P, M = "from polarmpm import plot\np=pts()\n", "from polarmpm import plot\n" + FIELDS
PLOT = [
    *variants("from polarmpm import plot\nplot.plot_points(VALUE)", (*OTHERS, "None"), "points"),
    *variants(
        P + "plot.plot_points(p,VALUE)",
        (*but(OTHERS, "type"), "np.zeros((len(p),2))", "np.zeros(len(p))*1j"),
        "values",
    ),
    *variants(
        P + "plot.plot_points(p,ax=VALUE)",
        (*OTHERS, "plot.subplots()[0]", "plot.subplots(solid=[0])[1][0]"),
        "ax",
    ),
    *variants(P + "plot.plot_points(p,label=VALUE)", but(OTHERS, '"text"'), "label"),
    *variants(
        P + "plot.plot_points(p,np.ones(len(p)),limits=VALUE)",
        (*but(OTHERS, "[1, 2]"), "(2,1)", "(0,np.nan)", "(1,)"),
        "limits",
    ),
    *variants(P + "plot.plot_points(p,np.ones(len(p)),cmap=VALUE)", (*OTHERS, "None", "''"), "cmap"),
    *variants(P + "plot.plot_points(p,undeformed=VALUE)", (*NOT_FLAGS, "None"), "undeformed"),
    *variants(P + "plot.plot_points(p,domains=VALUE)", (*NOT_FLAGS, "None"), "domains"),
    *variants(
        P + "plot.plot_points(p,length=VALUE)", (*OTHERS, "None", "(0,'m')", "('m',1)", "(1.0,)"), "length"
    ),
    *variants(
        "from polarmpm import plot\nplot.plot_points(pts(3),view=VALUE)",
        (*but(OTHERS, "[1, 2]"), "None", "(1,)"),
        "view",
    ),
    ("from polarmpm import plot\nplot.plot_points(pts(3),ax=plot.subplots()[1])", "bad", ("ax",)),
    (
        P
        + "plot.plot_points(p,list(range(len(p))),limits=np.array([0,3]),length=(np.float32(9),'mm')) and 1",
        "ok",
        (),
    ),
    *variants("from polarmpm import plot\nplot.plot_mesh(VALUE)", (*OTHERS, "None", "pts()"), "elements"),
    *variants(M + "plot.plot_mesh(m,VALUE)", but(OTHERS, "type"), "values"),
    *variants(M + "plot.plot_mesh(m,np.zeros(3),at=VALUE)", (*OTHERS, "None", "'edges'"), "at ="),
    *variants(M + "plot.plot_mesh(m,edges=VALUE)", (*NOT_FLAGS, "None"), "edges"),
    *variants("from polarmpm import plot\nplot.subplots(VALUE)", (*NOT_COUNTS, "None"), "rows"),
    *variants(
        "from polarmpm import plot\nplot.subplots(figsize=VALUE)",
        ("5", "(1,)", "(0,1)", "'ab'", "(np.nan,1)"),
        "figsize",
    ),
    *variants(
        "from polarmpm import plot\nplot.subplots(1,2,solid=VALUE)",
        ("2", "[2]", "['a']", "'01'", "[-1]", "None"),
        "solid",
    ),
    *variants("from polarmpm import plot\nplot.save(VALUE,OUT+'/a.png')", (*OTHERS, "None"), "figure"),
    *variants(
        "from polarmpm import plot\nplot.save(plot.subplots()[0],OUT+'/a.png',dpi=VALUE)",
        (*NOT_NUMBERS, "0", "-1"),
        "dpi",
    ),
    *variants(
        "from polarmpm import plot\nplot.save(plot.subplots()[0],OUT+VALUE)",
        ("'/a.nonsense'", "''"),
        "path",
    ),
    *variants(
        "from polarmpm import plot\nplot.load_displacement(VALUE)",
        (*but(OTHERS, "{}"), "None", "[([1],[1])]"),
        "curves",
    ),
    *variants(
        "from polarmpm import plot\nplot.load_displacement({'a': VALUE})",
        ("5", "([1],)", "([1],[1,2])", "('a','b')", "None"),
        "curves: a",
    ),
    *variants(
        "from polarmpm import plot\nplot.load_displacement({'a': ([1],[1])},comm=VALUE)", OTHERS, "comm"
    ),
]

ROW = "from polarmpm import study\nr=study.Row('a','b',1.0,errors={'e':0.1},cpu_s=1.0)\n"
STUDY = [
    *variants(
        "from polarmpm import study\nstudy.Discretisation('a','b',VALUE,print)",
        (*NOT_NUMBERS, "0", "-1"),
        "h =",
    ),
    *variants(
        "from polarmpm import study\nstudy.Discretisation('a','b',1.0,print,steps=VALUE)",
        (*NOT_COUNTS, "None"),
        "steps",
    ),
    *variants(
        "from polarmpm import study\nstudy.Discretisation('a','b',1.0,print,adaptive=VALUE)",
        NOT_FLAGS,
        "adaptive",
    ),
    *variants(
        "from polarmpm import study\nstudy.Discretisation(VALUE,'b',1.0,print)",
        (*but(OTHERS, '"text"'), "''", "None"),
        "method",
    ),
    *variants(
        "from polarmpm import study\nstudy.Discretisation('a','b',1.0,VALUE)",
        ("None", "5", "lambda: 1", "'f'"),
        "build",
    ),
    *variants(
        "from polarmpm import study\nstudy.Discretisation('a','b',1.0,print,VALUE)",
        ("5", "[1]", "{1: 2}", "None"),
        "arguments",
    ),
    (
        "from polarmpm import study\n"
        "study.Discretisation('a','b',np.float32(1),print,{},np.int64(3),np.bool_(True))",
        "ok",
        (),
    ),
    *variants(
        "from polarmpm import study\nstudy.run(VALUE,{})",
        (*but(OTHERS, "lambda x: x", "type"), "None", "[]"),
        "discretisations",
    ),
    *variants(
        ROW + "study.compare(r,VALUE)",
        (
            *but(OTHERS, "{}"),
            "None",
            "{'a': 'b'}",
            "{1: (0,)}",
            "{'a': (np.nan,)}",
            "{'a': (1,2)}",
            "{'a': lambda: 1}",
        ),
        "references",
    ),
    *variants(ROW + "study.compare(VALUE,{})", (*OTHERS, "None"), "row"),
    *variants("from polarmpm import study\nstudy.markdown(VALUE)", (*but(OTHERS, "{}"), "None"), "rows"),
    *variants(
        "from polarmpm import study\nstudy.write_csv(VALUE,OUT+'/a.csv')",
        (*but(OTHERS, "{}"), "None"),
        "rows",
    ),
    *variants(
        "from polarmpm import study\nstudy.read_csv(VALUE)",
        ("None", "5.5", "OUT+'/no.csv'", "OUT", "''"),
        "path",
    ),
    *variants(ROW + "study.orders([r],VALUE)", (*OTHERS, "None"), "name"),
    *variants(ROW + "study.time_for_error([r],'e',VALUE)", (*NOT_NUMBERS, "0", "-1"), "level"),
    *variants(ROW + "study.figures.errors([r],'e',over=VALUE)", (*OTHERS, "None"), "over"),
    *variants(ROW + "study.figures.errors([r],'e',ax=VALUE)", OTHERS, "ax"),
    *variants("from polarmpm import study\nstudy.Case(VALUE,print)", (*OTHERS, "None"), "problem"),
    *variants("from polarmpm import study\nstudy.Case(loaded(),VALUE)", ("None", "5", "'a'"), "result"),
]
DEMO = (
    "from polarmpm.study.commandline import arguments\nimport sys\ntry:\n"
    "    arguments('d',output='o',cell=1.0,points_per_cell=2,steps=3,basis='mpm',argv=VALUE)\n"
    "except SystemExit as e: code=e.code\nif code != 2: raise AssertionError(code)\ncode"
)
STUDY += [
    (DEMO.replace("VALUE", f"['{flag}','{value}']"), "ok", ())
    for flag, value in (
        ("--steps", "0"), ("--steps", "a"), ("--steps", "1.5"), ("--cell", "-1"), ("--cell", "nan"),
        ("--points-per-cell", "0"), ("--basis", "x"), ("--nothing", "1"),
    )
]  # fmt: skip

SAID = "class W(pm.Observer):\n    VALUE\nq=loaded()\nq.observers.append(W())\nrun(q)"
UNTIL = "q=loaded(f=1e3)\nlist(q.march_arc_length(1e-4,until=lambda s: VALUE,progress=False))"
MORE = [
    *variants(SAID, ("def after_commit(self,problem): pass", "after_commit=None"), "after_commit"),
    *variants(UNTIL, ("None", "np.array([1,2])", "'yes'", "1"), "until"),
    *variants(UNTIL, ("True", "np.bool_(True)"), expected="ok"),
    *variants(ROW + "study.write([r],VALUE)", ("None", "5", "''"), "folder"),
    *variants(ROW + "study.write_csv([r],VALUE)", ("None", "5", "''"), "path"),
    *variants(ROW + "study.figures.save_errors([r],VALUE)", ("None", "5", "''"), "path"),
    *variants(ROW + "study.markdown([r],unit=VALUE)", ("None", "5"), "unit"),
    *variants(ROW + "study.figures.errors([r],'e',slopes=VALUE)", ("None", "5", "['a']", "'a'"), "slopes"),
    *variants(ROW + "study.Row('a','b',VALUE)", (*NOT_NUMBERS, "0"), "h ="),
    *variants(
        f"q=clamped()\nq.load({ON_TIP},force=VALUE)\nrun(q)",
        (
            "np.ma.array([0,5])",
            "__import__('functools').partial(lambda a,t: (0,a*t),5)",
            "lambda t,x=None: (0,t)",
        ),
        expected="ok",
    ),
    ("q=clamped()\nq.fix(lambda x: x[:,0]>2.9,ux=np.add)", "bad", ("ux",)),
    ("q=clamped()\nq.fix(lambda x: x[:,0]>2.9,ux=np.sin)\nrun(q)", "ok", ()),
    ("from fractions import Fraction\nrun(loaded(),1,to=Fraction(1,2))", "ok", ()),
    ("q=loaded()\nrun(q)\nq.system_at(2.0).evaluate(True)\nrun(q,1,to=2.0)", "ok", ()),
    ("q=femc()\nq.traction(pm.Surface.line((0,1),(3,1),9),force=(0,1))", "bad", ("this mesh",)),
    (
        "q=femc()\nrun(q)\ntry: q.traction(pm.Surface.line((0,1),(3,1),9),force=(0,1))\n"
        "except pm.InputError: pass\nassert not q.terms\nrun(q,1,to=2)",
        "ok",
        (),
    ),
    (
        "class T(pm.Term):\n    def pieces(self): return []\nq=loaded()\nq.add(T())",
        "bad",
        ("pieces",),
    ),
]

CASES = [
    *FIRST, *CONTROLS, *CONSTRUCTORS, *FIX, *LOADS, *RELEASE, *MARCH, *ONE_BODY, *RESULTS, *TERMS, *SOLVERS,
    *SELECTIONS, *PLOT, *STUDY, *MORE,
]  # fmt: skip
