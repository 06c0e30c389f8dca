"""Bad calls of geometry, bodies, materials, fields, bases and amplitudes; see `operation_calls`."""

CASES = [
    ('pm.Grid.box(("a","b"),(1,1),0.5)', "bad", ("lower",)),
    ("pm.Grid.box(None,(1,1),0.5)", "bad", ("lower",)),
    ('pm.Grid.box((0,0),(1,1),"x")', "bad", ("cell",)),
    ("pm.Grid.box((0,0),(1,1),None)", "bad", ("cell",)),
    ("pm.Grid.box((0,0),(1,1),1j)", "bad", ("cell",)),
    ("pm.Grid.box((0,0),(1,1),(0.5,))", "bad", ("cell",)),
    ("pm.Grid.box((0,0),(1,1),-0.5)", "bad", ("cell",)),
    ('pm.Grid.box((0,0),(1,1),float("nan"))', "bad", ("cell",)),
    ('pm.Grid.box((0,0),(float("inf"),1),0.5)', "bad", ("upper", "lower")),
    ("pm.Grid.box((0,),(1,),0.5)", "bad", ("lower", "coordinates")),
    ("pm.Grid.box((0,0,0,0),(1,1,1,1),0.5)", "bad", ("lower", "coordinates")),
    ("pm.Grid.box([[0,0]],[[1,1]],0.5)", "bad", ("lower",)),
    ("pm.Grid.box((0,0),(1,1),1e-300)", "bad", ("cell", "lattice")),
    ("pm.Grid.box((0,0),(1,1),0.3)", "bad", ("cell",)),
    (
        "pm.Grid.box((0,0),(1,1),0.5,comm=None)\npm.seed(pm.Grid.box((0,0),(1,1),0.5,comm=None),material=MP)",
        "bad",
        ("comm",),
    ),
    ('pm.Grid.box((0,0),(1,1),0.5,comm="world")', "bad", ("comm",)),
    ("g=pm.Grid((0.0,0.0),(0.0,1.0),(3,3))\npm.seed(g,material=MP)", "bad", ("cell",)),
    ("g=pm.Grid((0.0,0.0),(1.0,1.0),(-3,3))\npm.seed(g,material=MP)", "bad", ("shape",)),
    ("pm.Grid.box((0,0),(1e9,1e9),1.0)", "ok", ()),
    ("pm.Grid.box((1e16,0),(1e16+4,1),1.0)", "either", ()),
    ("pm.seed(None,material=MP)", "bad", ("grid",)),
    ("pm.seed(grid(),inside)", "bad", ("material",)),
    ('pm.seed(grid(),inside,material="steel")', "bad", ("material",)),
    ("pm.seed(grid(),inside,material=pm.MicropolarElastic)", "bad", ("material",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=0)", "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=-2)", "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=2.0)", "bad", ("points_per_cell",)),
    ('pm.seed(grid(),inside,material=MP,points_per_cell="2")', "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=None)", "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=True)", "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=(2,2,2))", "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=100000)", "bad", ("points_per_cell", "memory")),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=10**20)", "bad", ("points_per_cell",)),
    ("pm.seed(pm.Grid.box((0,0),(1e9,1e9),1.0),material=MP)", "bad", ("bounds", "grid", "points")),
    ('pm.seed(grid(),inside,material=MP,layout="random")', "bad", ("layout",)),
    ("pm.seed(grid(),inside,material=MP,layout=[1])", "bad", ("layout",)),
    ("pm.seed(grid(),inside,material=MP,bounds=5)", "bad", ("bounds",)),
    ("pm.seed(grid(),inside,material=MP,bounds=((0,0),))", "bad", ("bounds",)),
    ('pm.seed(grid(),inside,material=MP,bounds=((0,0),("a",1)))', "bad", ("bounds",)),
    ('pm.seed(grid(),inside,material=MP,bounds=((0,0),(float("nan"),1)))', "bad", ("bounds",)),
    ("pm.seed(grid(),inside,material=MP,bounds=((1,1),(0,0)))", "bad", ("bounds",)),
    ("pm.seed(grid(),lambda x: x[:,0],material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda x: True,material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda x: None,material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda x: x[:,2]>0,material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda: 1,material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda x: x[:,0]>99,material=MP)", "bad", ("inside",)),
    ('pm.seed(grid(),"box",material=MP)', "bad", ("inside",)),
    ("pm.seed_mesh(grid(),None,material=MP)", "bad", ("mesh",)),
    ('pm.seed_mesh(grid(),"/nonexistent.msh",material=MP)', "bad", ("mesh",)),
    ("pm.seed_mesh(grid(),mesh2(),material=MP,degree=0)", "either", ("degree",)),
    ("pm.seed_mesh(grid(),mesh2(),material=MP,degree=-1)", "bad", ("degree",)),
    ('pm.seed_mesh(grid(),mesh2(),material=MP,degree="2")', "bad", ("degree",)),
    ("pm.seed_mesh(grid(),mesh2(),material=MP,degree=500)", "bad", ("degree",)),
    ("pm.seed_mesh(grid(),mesh2(),material=MP,degree=2.5)", "bad", ("degree",)),
    (
        'open(OUT+"/g.msh","w").write("garbage")\npm.seed_mesh(grid(),OUT+"/g.msh",material=MP)',
        "bad",
        ("mesh",),
    ),
    (
        'open(OUT+"/g.geo","w").write("garbage(")\npm.seed_mesh(grid(),OUT+"/g.geo",material=MP)',
        "bad",
        ("mesh",),
    ),
    ('open(OUT+"/e.msh","wb").write(b"")\npm.seed_mesh(grid(),OUT+"/e.msh",material=MP)', "bad", ("mesh",)),
    ("pm.Points(np.zeros((3,2)),np.ones(3),np.ones((3,2)),None,grid().comm)", "bad", ("material",)),
    ("pm.Points(np.zeros((3,2)),np.ones(2),np.ones((3,2)),MP,grid().comm)", "bad", ("volume",)),
    (
        "p=pm.Points(np.zeros((3,2)),-np.ones(3),np.ones((3,2)),MP,grid().comm)\n"
        'pm.QuasiStatic(grid(),p,basis="mpm")',
        "bad",
        ("volume",),
    ),
    (
        "p=pm.Points(np.zeros((3,2)),np.ones(3)*np.nan,np.ones((3,2)),MP,grid().comm)\n"
        'pm.QuasiStatic(grid(),p,basis="mpm")',
        "bad",
        ("volume",),
    ),
    (
        "p=pm.Points(np.full((3,2),np.nan),np.ones(3),np.ones((3,2)),MP,grid().comm)\n"
        'pm.QuasiStatic(grid(),p,basis="mpm")',
        "bad",
        ("outside", "x"),
    ),
    (
        "p=pm.Points(np.zeros((3,2)),np.ones(3),-np.ones((3,2)),MP,grid().comm)\n"
        'q=pm.QuasiStatic(grid(),p,basis="gimpm")\n'
        "q.fix(lambda x: x[:,0]<0,u=0,theta=0)\n"
        "q.attempt(1.0)",
        "bad",
        ("half_length",),
    ),
    (
        "p=pm.Points(np.zeros((3,2)),np.ones(3),np.full((3,2),9.0),MP,grid().comm)\n"
        'q=pm.QuasiStatic(grid(),p,basis="gimpm")\n'
        "q.fix(lambda x: x[:,0]<0,u=0,theta=0)\n"
        "q.attempt(1.0)",
        "bad",
        ("half_length", "domain"),
    ),
    ("p=pm.Points(np.zeros((3,4)),np.ones(3),np.ones((3,4)),MP,grid().comm)", "bad", ("x", "dimension")),
    (
        "p=pm.Points(np.zeros((0,2)),np.ones(0),np.ones((0,2)),MP,grid().comm)\n"
        'q=pm.QuasiStatic(grid(),p,basis="mpm")\n'
        "run(q)",
        "bad",
        ("point",),
    ),
    ("p=pm.Points([[0,0]],[1.0],[[1,1]],MP,grid().comm)", "bad", ("x",)),
    ("pts().where(lambda x: 1)", "bad", ("predicate",)),
    ("pts().where(None)", "bad", ("predicate",)),
    ("pts().where(lambda x: x[:,0]/0)", "bad", ("predicate",)),
    ("pts().farthest(None)", "bad", ("direction",)),
    ('pts().farthest("x")', "bad", ("direction",)),
    ("pts().farthest((0,0))", "bad", ("direction",)),
    ("pts().farthest((1,0,0))", "bad", ("direction",)),
    ('len(pts().farthest((float("inf"),0)))', "bad", ("direction",)),
    ("len(pts().farthest((1,0),tolerance=-1.0))", "bad", ("tolerance",)),
    ('len(pts().farthest((1,0),tolerance=float("nan")))', "bad", ("tolerance",)),
    ('len(pts().farthest((1,0),tolerance="a"))', "bad", ("tolerance",)),
    ("len(pts().nearest((0,0),count=0))", "bad", ("count",)),
    ("len(pts().nearest((0,0),count=-1))", "bad", ("count",)),
    ("len(pts().nearest((0,0),count=1.5))", "bad", ("count",)),
    ("len(pts().nearest((0,0),count=10**9))", "either", ("count",)),
    ('pts().nearest((float("nan"),0)).ids', "bad", ("position",)),
    ('pts().nearest("ab")', "bad", ("position",)),
    ("pts().rows([1,2])", "bad", ("selection",)),
    ("p=pts()\np.mean(np.ones(3))", "bad", ("values",)),
    ("p=pts()\np.mean(np.ones(3), p.nearest((0,0)))", "bad", ("values",)),
    ('p=pts()\np.mean_displacement("tip")', "bad", ("selection",)),
    ("p=pts()\np.join(p)\nlen(p)", "bad", ("other", "itself")),
    ("pts().join(None)", "bad", ("other",)),
    ('pts().join("x")', "bad", ("other",)),
    (
        "p=pts()\n"
        "p.join(pts())\n"
        'q=pm.QuasiStatic(grid(),p,basis="mpm")\n'
        '"same body joined twice: mass doubled"',
        "either",
        (),
    ),
    ("p=pts()\np.assign(p.nearest((0,0)),None)", "bad", ("material",)),
    ("p=pts()\np.assign([0,1],VM)", "bad", ("selection",)),
    ("p=pts()\np.assign(p.nearest((0,0)),NH)", "bad", ("material",)),
    ("p=pts()\np.assign(pm.Selection(np.array([10**6])),VM)", "bad", ("selection",)),
    ("p=pts()\ns=pm.Selection(np.array([5,3,1]))\nlen(p.rows(s))==3 or 1/0", "either", ()),
    (
        "q=clamped()\n"
        "s=pm.Selection(np.array([5,3,9,1]))\n"
        "q.load(s,force=(0,10.0))\n"
        "run(q)\n"
        "f=q.reaction(q.supports[0])[0]\n"
        "assert abs(f[1]+10)>1e-6\n"
        "f",
        "bad",
        ("selection",),
    ),
    (
        "q=clamped()\n"
        "q.load(pm.Selection(np.array([3,3,3])),force=(0,10.0))\n"
        "run(q)\n"
        "f=q.reaction(q.supports[0])[0]\n"
        "assert abs(f[1]+10)>1e-6\n"
        "f",
        "bad",
        ("selection",),
    ),
    (
        "q=clamped()\n"
        "q.load(pm.Selection(np.array([10**9])),force=(0,10.0))\n"
        "run(q)\n"
        "q.reaction(q.supports[0])[0]",
        "bad",
        ("selection",),
    ),
    (
        "q=clamped()\nq.load(pm.Selection([1,2]),force=(0,10.0))\nrun(q)\nq.reaction(q.supports[0])[0]",
        "bad",
        ("selection",),
    ),
    (
        "q=clamped()\n"
        "q.load(pm.Selection(np.array([1.5,2.5])),force=(0,10.0))\n"
        "run(q)\n"
        "q.reaction(q.supports[0])[0]",
        "bad",
        ("selection",),
    ),
    (
        'd=dict(lam=1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)\nd["lam"]="1"\npm.MicropolarElastic(**d)',
        "bad",
        ("lam",),
    ),
    (
        'd=dict(lam=1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)\nd["mu"]="1"\npm.MicropolarElastic(**d)',
        "bad",
        ("mu",),
    ),
    (
        'd=dict(lam=1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)\nd["kappa"]="1"\npm.MicropolarElastic(**d)',
        "bad",
        ("kappa",),
    ),
    (
        'd=dict(lam=1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)\nd["alpha"]="1"\npm.MicropolarElastic(**d)',
        "bad",
        ("alpha",),
    ),
    (
        'd=dict(lam=1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)\nd["beta"]="1"\npm.MicropolarElastic(**d)',
        "bad",
        ("beta",),
    ),
    (
        'd=dict(lam=1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)\nd["gamma"]="1"\npm.MicropolarElastic(**d)',
        "bad",
        ("gamma",),
    ),
    ("pm.MicropolarElastic(lam=True,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)", "either", ("lam",)),
    ("pm.MicropolarElastic(lam=1.,mu=1.,kappa=1j,alpha=0.,beta=1.,gamma=1.)", "bad", ("kappa",)),
    ("pm.MicropolarElastic(lam=1.,mu=1.,kappa=None,alpha=0.,beta=1.,gamma=1.)", "bad", ("kappa",)),
    ("pm.MicropolarElastic(lam=np.ones(3),mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)", "bad", ("lam",)),
    ("pm.MicropolarElastic()", "bad", ("lam",)),
    ("pm.MicropolarElastic.from_engineering(E=1e6,nu=0.5,n=0,l_b=0,l_t=0,psi=1)", "bad", ("nu",)),
    ("pm.MicropolarElastic.from_engineering(E=1e6,nu=0.3,n=1,l_b=0,l_t=0,psi=1)", "bad", ("n =",)),
    ("pm.MicropolarElastic.from_engineering(E=1e6,nu=0.3,n=0.1,l_b=1,l_t=3,psi=1)", "bad", ("l_t",)),
    ("pm.MicropolarElastic.from_engineering(E=1e6,nu=0.3,n=0.1,l_b=1,l_t=1,psi=0)", "bad", ("psi",)),
    (
        "pm.MicropolarElastic.from_engineering(E=1e306,nu=0.3,n=0.1,l_b=1e10,l_t=1,psi=1)",
        "bad",
        ("is not a finite", "out of range"),
    ),
    ('pm.MicropolarElastic.bounded_stiffness(lam=1,mu=1,kappa="a",l_b=1)', "bad", ("kappa",)),
    (
        "q=loaded(2,pm.MicropolarElastic(lam=1e300,mu=1e300,kappa=1e300,alpha=0.,beta=1.,gamma=1.))\n"
        "run(q)\n"
        "show(q)",
        "either",
        ("modul", "stiff", "finite"),
    ),
    (
        "q=loaded(2,pm.MicropolarElastic(lam=1e-300,mu=1e-300,kappa=0,alpha=0.,beta=0.,gamma=0.),f="
        "1e-302)\n"
        "run(q)\n"
        "show(q)",
        "either",
        ("singular", "diverged", "tried"),
    ),
    ("pm.NeoHookean(lam=-1,mu=1)", "bad", ("lam",)),
    ('pm.NeoHookean("a","b")', "bad", ("lam",)),
    ('pm.Hencky(lam=1,mu=float("nan"))', "bad", ("mu",)),
    ("pm.UserEnergy(None)", "bad", ("function",)),
    ("pm.UserEnergy(lambda E,G,p: 1.0, values=5)", "bad", ("values",)),
    ("pm.UserEnergy(lambda E,G,p: p.a, values={1: 2.0})", "bad", ("values",)),
    ('pm.UserEnergy(lambda E,G,p: p.a, values={"a b": 2.0})', "either", ("values",)),
    ('pm.UserEnergy(lambda E,G,p: p.a, values={"a": "x"})', "bad", ("a =",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: p.b*ufl.tr(E), {"a":1.0}))', "bad", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: E, {"a":1.0}))', "bad", ("scalar",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: None, {"a":1.0}))', "bad", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: "text", {"a":1.0}))', "bad", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: 1/0, {"a":1.0}))', "bad", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G: ufl.tr(E), {"a":1.0}))', "bad", ("energy",)),
    (
        'q=loaded(2,pm.UserEnergy(lambda E,G,p: 0.0, {"a":1.0}))\nrun(q)\nshow(q)',
        "bad",
        ("singular", "energy", "stiff", "diverged", "tried"),
    ),
    (
        'q=loaded(2,pm.UserEnergy(lambda E,G,p: p.a*ufl.tr(E), {"a":1.0}))\nrun(q)\nshow(q)',
        "bad",
        ("singular", "diverged", "tried"),
    ),
    (
        'q=loaded(2,pm.UserEnergy(lambda E,G,p: p.a*ufl.sqrt(ufl.inner(E,E))+p.a*ufl.inner(G,G), {"'
        'a":1e6}))\n'
        "run(q)\n"
        "show(q)",
        "bad",
        ("not finite", "nan", "diverged"),
    ),
    (
        'q=loaded(2,pm.UserEnergy(lambda E,G,p: -p.a*ufl.inner(E,E)-p.a*ufl.inner(G,G), {"a":1e6}))\n'
        "run(q)\n"
        "show(q)",
        "either",
        ("singular", "diverged", "tried"),
    ),
    (
        "q=loaded(2,pm.UserEnergy(lambda E,G,p: p.a*ufl.inner(E,E)+p.a*ufl.inner(G,G)+ufl.bessel_J("
        '0,E[0,0]), {"a":1e6}))\n'
        "run(q)",
        "bad",
        ("bessel",),
    ),
    (
        "import random\n"
        "q=loaded(2,pm.UserEnergy(lambda E,G,p: p.a*random.random()*ufl.inner(E,E)+p.a*ufl.inner(G,"
        'G), {"a":1e6}))\n'
        "run(q)\n"
        "show(q)",
        "either",
        (),
    ),
    (
        "# falsely isotropic\n"
        "f=lambda E,G,p: p.a*E[0,0]**2+100*p.a*E[1,1]**2+p.a*ufl.inner(E,E)+p.a*ufl.inner(G,G)\n"
        "r=[]\n"
        "for iso in (False,True):\n"
        '    q=loaded(2,pm.UserEnergy(f,{"a":1e6},isotropic=iso),f=2e5)\n'
        "    run(q,5)\n"
        "    r.append(q.points.mean_displacement())\n"
        'assert abs(r[0]-r[1]).max()>1e-9, "same"\n'
        "r",
        "bad",
        ("isotropic",),
    ),
    ("DruckerPrager(None,phi=0.5,c=1e3,l_p=0.1)", "bad", ("elastic", "material")),
    ("DruckerPrager(VM,phi=0.5,c=1e3,l_p=0.1)", "bad", ("elastic",)),
    ("DruckerPrager(MP,phi=30,c=1e3,l_p=0.1)", "bad", ("phi",)),
    ("DruckerPrager(MP,phi=0.5,psi=0.6,c=1e3,l_p=0.1)", "bad", ("psi",)),
    ("DruckerPrager(MP,phi=0.5,l_p=0.1)", "bad", ("c =",)),
    ("DruckerPrager(MP,phi=0.5,c=1,k=1,l_p=0.1)", "bad", ("c =",)),
    ('DruckerPrager(MP,phi=0.5,c="1",l_p=0.1)', "bad", ("c =",)),
    ("DruckerPrager(MP,phi=0.5,c=1)", "bad", ("l_p",)),
    ("DruckerPrager(NH,phi=0.5,c=1,l_p=1)", "bad", ("l_p",)),
    ("VonMises(MP,k=0,l_p=0.1)", "bad", ("k =",)),
    ("VonMises(MP,k=-1,l_p=0.1)", "bad", ("k =",)),
    ("VonMises(MP,l_p=0.1)", "bad", ("k =",)),
    ('VonMises(MP,k=1,l_p=float("inf"))', "bad", ("l_p",)),
    ("UserPlasticity(MP,None)", "bad", ("function",)),
    ('prob(2,UserPlasticity(MP,lambda t,n,c,p: t,{"y":1.0}))', "bad", ("yield", "scalar")),
    ('prob(2,UserPlasticity(MP,lambda t,n,c,p: p.zz,{"y":1.0}))', "bad", ("yield", "zz")),
    ('UserPlasticity(MP,lambda t,n,c,p: p.y,{"mu":1.0})', "bad", ("mu",)),
    (
        'q=loaded(2,UserPlasticity(MP,lambda t,n,c,p: ufl.inner(t,t)+1.0,{"y":1.0}))\nrun(q)',
        "bad",
        ("yield", "return", "stress", "tried"),
    ),
    ("class M(pm.Material): pass\nprob(2,M())", "bad", ("energy",)),
    (
        "class M(pm.Material):\n"
        "    def energy(self,E,G,p): return ufl.inner(E,E)\n"
        '    def parameters(self): return {"a": float("nan")}\n'
        "q=loaded(2,M())\n"
        "run(q)\n"
        "show(q)",
        "either",
        ("a", "finite"),
    ),
    (
        "class M(pm.Material):\n"
        "    def energy(self,E,G,p): return p.a*ufl.inner(E,E)+p.a*ufl.inner(G,G)\n"
        '    def parameters(self): return {"a": float("nan")}\n'
        "q=loaded(2,M())\n"
        "run(q)\n"
        "show(q)",
        "bad",
        ("a", "finite", "nan"),
    ),
    ("pm.plane()", "bad", ("x, y, z",)),
    ("pm.plane(x=1,y=1)", "bad", ("x, y, z",)),
    ("pm.plane(w=1)", "bad", ("x, y, z",)),
    ('pm.plane(x="a")', "bad", ("x",)),
    ("pm.plane(x=None)", "bad", ("x",)),
    ('prob().fix(pm.plane(x=float("nan")),u=0)', "bad", ("x",)),
    ('prob().fix(pm.plane(x=float("inf")),u=0)', "bad", ("x",)),
    ('prob(basis="bspline").fix(pm.plane(x=float("nan")),u=0)', "bad", ("x",)),
    ('fem().fix(pm.plane(x=float("nan")),u=0)', "bad", ("x",)),
    ('pm.plane(x=0.0,beyond="left")', "bad", ("beyond",)),
    ("pm.plane(x=0.0,beyond=None)", "bad", ("beyond",)),
    ('pm.plane(x=0.0,moving="yes")', "bad", ("moving",)),
    ("prob().fix(pm.plane(x=0.5),u=0)", "bad", ("plane",)),
    ("prob().fix(pm.plane(x=100.0),u=0)", "bad", ("plane",)),
    ("prob().fix(pm.plane(z=0.0),u=0)", "bad", ("plane",)),
    ('prob(basis="bspline").fix(pm.plane(x=0.0),u=0)', "bad", ("bspline",)),
    (
        "q=loaded()\nrun(q)\nq.points.x[:]=np.nan\nrun(q,1,to=2.0)\nshow(q)",
        "bad",
        ("outside", "x", "nan", "finite"),
    ),
    (
        "q=loaded(reset=1)\nrun(q)\nq.points.F[:]=np.nan\nrun(q,1,to=2.0)\nshow(q)",
        "bad",
        ("F", "nan", "finite"),
    ),
    (
        "q=loaded(reset=1)\nrun(q)\nq.points.q[:]=0\nrun(q,1,to=2.0)\nshow(q)",
        "bad",
        ("q", "nan", "finite", "unit"),
    ),
    (
        "q=loaded(reset=1)\nrun(q)\nq.points.F[:]*=-1\nrun(q,1,to=2.0)\nshow(q)",
        "bad",
        ("F", "inside out", "det", "tried"),
    ),
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
    ("q=loaded()\nq.points.assign(q.points.nearest((1,0)),VM)\nrun(q)", "bad", ("material",)),
    (
        "M2=pm.MicropolarElastic.from_engineering(E=1e3,nu=0.3,n=0.3,l_b=0.1,l_t=0.1,psi=1.0)\n"
        "p=pts()\n"
        "p.assign(p.where(lambda x:x[:,0]>2),M2)\n"
        'q=pm.QuasiStatic(grid(),p,basis="mpm",reset=None)\n'
        "q.fix(lambda x:x[:,0]<1e-6,u=0,theta=0)\n"
        "q.load(p.farthest((1,0)),force=(0,1.0))\n"
        "run(q)\n"
        "u=p.mean_displacement()\n"
        "p.assign(p.where(lambda x:x[:,0]<1.5),M2)\n"
        "run(q,1,to=1.5)\n"
        "e=q.energies()\n"
        "u,p.mean_displacement(),e",
        "bad",
        ("material",),
    ),
    ("# join after problem\nq=loaded()\nq.points.join(pts())\nrun(q)\nshow(q)", "bad", ("points",)),
    (
        "# join after a step\nq=loaded(reset=None)\nrun(q)\nq.points.join(pts())\nrun(q,1,to=2.0)\nshow(q)",
        "bad",
        ("points",),
    ),
    ("pm.Surface(None,1,2)", "bad", ("Surface",)),
    ("pm.Surface([[0,0]],[1.0],[[1,1]])", "bad", ("normal",)),
    ("pm.Surface([[0,0]],[0.0],[[1,0]])", "bad", ("area",)),
    ("pm.Surface([[0,0]],[1.0,2],[[1,0]])", "bad", ("area",)),
    ('pm.Surface([[0,float("nan")]],[1.0],[[1,0]])', "bad", ("x",)),
    ("pm.Surface.line((0,0),(0,0),3)", "bad", ("line",)),
    ("pm.Surface.line((0,0),(1,0),0)", "bad", ("points",)),
    ("pm.Surface.line((0,0),(1,0),2.5)", "bad", ("points",)),
    ("pm.Surface.rectangle((0,0,0),(1,0,0),(2,0,0),3)", "bad", ("parallel",)),
    ("pm.Surface.rectangle((0,0,0),(0,0,0),(0,1,0),3)", "bad", ("edge",)),
    ("pm.Surface.rectangle((0,0,0),(1,0,0),(0,1,0),(1,2,3))", "bad", ("points",)),
]
